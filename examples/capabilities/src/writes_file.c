/* Writes a line for each step into `steps.txt` in its resources, or, where that cannot be written,
 * into a temporary file without a name: time, step size and x at the end of the step. */
#include "lag.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char FILE_NAME[] = "/steps.txt";

/* The path of a `file` URI, with %XX decoded. */
static void path_of(const char *uri, char *path, size_t size)
{
    static const char SCHEME[] = "file://";
    if (strncmp(uri, SCHEME, sizeof SCHEME - 1) == 0)
        uri += sizeof SCHEME - 1;
    size_t n = 0;
    while (*uri && n + 1 < size) {
        char code[3] = "", *end = code;
        if (*uri == '%' && uri[1] && uri[2])
            memcpy(code, uri + 1, 2);
        const long value = strtol(code, &end, 16);
        if (end == code + 2) {
            path[n++] = (char)value;
            uri += 3;
        } else {
            path[n++] = *uri++;
        }
    }
    path[n] = '\0';
}

static const char *open_file(void *hidden, const char *resources)
{
    FILE **file = hidden;
    char path[4096];
    *file = NULL;
    if (resources) {
        path_of(resources, path, sizeof path - sizeof FILE_NAME);
        strcat(path, FILE_NAME);
        *file = fopen(path, "a");
    }
    if (!*file)
        *file = tmpfile();
    return *file ? NULL : "no file can be written";
}

static void close_file(void *hidden)
{
    fclose(*(FILE **)hidden);
}

static Outcome write_step(void *state, void *hidden, Step *step)
{
    FILE *file = *(FILE **)hidden;
    lag_step(state, hidden, step);
    if (fprintf(file, "%.17g %.17g %.17g\n", step->t, step->h, ((Lag *)state)->x) > 0 &&
        fflush(file) == 0)
        return STEP_TAKEN;
    step->reason = "the file cannot be written";
    return STEP_FAILED;
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .hidden_size = sizeof(FILE *),
                             LAG_BEHAVIOUR,
                             .step = write_step,
                             .open = open_file,
                             .close = close_file};
