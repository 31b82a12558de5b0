/* FMI 2.0: what the files of the two interfaces know of each other. */
#ifndef FMI2_FRONT_H
#define FMI2_FRONT_H

#include "fmi2Functions.h"
#include "instance.h"

static inline fmi2Status status_of(Status status)
{
    return (fmi2Status)status; /* the same numbers */
}

/* What each interface says. */
extern const fmi2Type interface_type;
extern const Mode mode_after_initialization;

/* From one of the modes `from`, else an error and a message, to `to`. */
fmi2Status change_mode(fmi2Component c, const char *function, unsigned from, Mode to);

#endif
