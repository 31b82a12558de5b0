/* FMI 3.0: what the files of the two interfaces know of each other. */
#ifndef FMI3_FRONT_H
#define FMI3_FRONT_H

#include "fmi3Functions.h"
#include "instance.h"

#include <math.h>

#define NO_EVENT INFINITY

static inline fmi3Status status_of(Status status)
{
    return (fmi3Status)status; /* the same numbers */
}

/* A new instance, or NULL and a message. */
Instance *instantiate(const char *function, fmi3String name, fmi3String token,
                      fmi3String resources, bool logging_on, fmi3InstanceEnvironment environment,
                      fmi3LogMessageCallback logger);

/* From one of the modes `from`, else an error and a message, to `to`. */
fmi3Status change_mode(fmi3Instance c, const char *function, unsigned from, Mode to);

/* What each interface says. */
Mode mode_after_initialization(const Instance *instance);
/* False and a message if one of the variables must not be set now. */
bool may_be_set(const Instance *instance, const char *function,
                const fmi3ValueReference reference[], size_t n);

#endif
