/* A lag that changes the process around it, when it is instantiated and in each step: where it works,
 * what it may write, what it says where, how numbers are written, and what becomes of Ctrl-C. When
 * it is instantiated, and when its output was calculated, it changes how numbers are rounded and
 * what traps. Its own numbers are those of any other lag. */
#define _GNU_SOURCE

#include "lag.h"

#include <fcntl.h>
#include <fenv.h>
#include <locale.h>
#include <signal.h>
#include <stdio.h>
#include <sys/stat.h>
#include <unistd.h>

static void change_process(void)
{
    printf("a line on standard output\n");
    fflush(stdout);
    if (chdir("/") != 0)
        return;
    umask(0777);
    setlocale(LC_ALL, "C");
    signal(SIGINT, SIG_IGN);
    signal(SIGTERM, SIG_IGN);
    const int nowhere = open("/dev/null", O_WRONLY);
    if (nowhere >= 0) {
        dup2(nowhere, STDOUT_FILENO);
        dup2(nowhere, STDERR_FILENO);
        close(nowhere);
    }
}

static void change_arithmetic(void)
{
    fesetround(FE_UPWARD);
#ifdef __linux__
    feenableexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
#endif
}

static void calculate(void *state, double time)
{
    lag_calculate(state, time);
    change_arithmetic();
}

static const char *open_lag(void *hidden, const char *resources)
{
    (void)hidden;
    (void)resources;
    change_process();
    change_arithmetic();
    return NULL;
}

static Outcome step_lag(void *state, void *hidden, Step *step)
{
    const Outcome outcome = lag_step(state, hidden, step);
    change_process();
    return outcome;
}

const Behaviour behaviour = {.state_size = sizeof(Lag),
                             .start = lag_start,
                             .find = lag_find,
                             .initialized = lag_initialized,
                             .calculate = calculate,
                             .input_derivative = lag_input_derivative,
                             .output_derivative = lag_output_derivative,
                             .step = step_lag,
                             .open = open_lag};
