/* A co-simulation slave of FMI 2.0 around one `model`. */
#ifndef COSIMULATION_SLAVE_H
#define COSIMULATION_SLAVE_H

#include "fmi2Functions.h"
#include "model.h"

#include <stdint.h>

enum { MAX_INPUT_ORDER = 3 };

/* Bits, so that "allowed in" is a mask. */
typedef enum {
    INSTANTIATED = 1,
    INITIALIZATION_MODE = 2,
    STEP_COMPLETE = 4,
    STEP_FAILED = 8, /* fmi2DoStep returned fmi2Discard: it went only part of the way */
    TERMINATED = 16,
    ERROR = 32 /* fmi2DoStep returned fmi2Error */
} Mode;

/* Everything that decides what the slave does next, and nothing else: no pointer, no padding.
 * Copying it is saving the slave, copying it back is restoring it bit for bit. */
typedef struct {
    double time;      /* s, the communication point */
    double stop_time; /* s, INFINITY if undefined */
    double tolerance;
    double max_step;   /* s, 0: any */
    double micro_step; /* s, what the integrator tries next, 0: it has not run yet */
    double x[MAX_STATES];
    /* Row j is the j-th derivative, so u(time + tau) = sum_j u[j] tau^j / j!. */
    double u[MAX_INPUT_ORDER + 1][MAX_INPUTS];
    double p[MAX_PARAMETERS];
    int32_t mode;
    int32_t experiment_is_set_up;
} SlaveState;

typedef struct {
    SlaveState state;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    unsigned log_categories; /* bits: index into the table of categories */
    char name[];             /* instance name */
} Slave;

/* The slave behind `component` if `function` is allowed in its mode, else NULL and a message. */
Slave *enter(fmi2Component component, const char *function, unsigned allowed);

/* Log "<function>: <message>" and return `status`. Errors are always logged, the rest only where
 * debug logging is on. */
#if defined __GNUC__
__attribute__((format(printf, 4, 5)))
#endif
fmi2Status report(const Slave *slave, fmi2Status status, const char *function, const char *format,
                  ...);

#endif
