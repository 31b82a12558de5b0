/* What the FMUs of all versions of FMI have in common: modes, messages, values, saved states and
 * the checks before a step. The numbers of the statuses are the same in all versions.
 */
#ifndef INSTANCE_H
#define INSTANCE_H

#include "behaviour.h"

typedef enum { OK, WARNING, DISCARD, ERROR } Status;

/* Bits, so that "allowed in" is a mask. */
typedef enum {
    INSTANTIATED = 1,
    CONFIGURATION = 2,
    INITIALIZATION = 4,
    EVENT = 8,
    STEP = 16, /* between two steps */
    STEP_DISCARDED = 32,
    INTERMEDIATE_UPDATE = 64,
    CONTINUOUS_TIME = 128,
    TERMINATED = 256,
    FAILED = 512, /* only a restored state, a reset or the end leads on */
    ANY_MODE = 1023
} Mode;

/* What is saved beside the state of the behaviour. */
typedef struct {
    double time, stop_time; /* s; INFINITY: no stop time */
    double tolerance;
    uint32_t mode;
    uint32_t is_set_up;    /* FMI 2.0: fmi2SetupExperiment has been called */
    uint64_t wants_to_end; /* the last step ended with the wish to terminate */
} Standing;

typedef struct Instance {
    Standing standing;
    void *state, *hidden;
    void (*log)(const struct Instance *instance, Status status, const char *category,
                const char *text);
    void *environment;      /* of the importer */
    void (*callback)(void); /* the importer's logger, known to `log` alone */
    bool logs_all;          /* else errors only */
    void *front;            /* what one version of FMI keeps beside */
    char name[];
} Instance;

/* NULL: out of memory. The behaviour is opened by `instance_open`. */
Instance *instance_new(const char *name);
/* False and a message if the GUID is wrong or the behaviour says no. */
bool instance_open(Instance *instance, const char *function, const char *guid,
                   const char *resources);
void instance_free(Instance *instance);
void instance_reset(Instance *instance);

/* What the importer asks for: the same, or less, as RESET says. */
void reset_by_importer(Instance *instance);

/* The instance behind `component` if `function` is allowed in its mode, else NULL and a message. */
Instance *enter(void *component, const char *function, unsigned allowed);

/* Log "<function>: <message>" and return `status`. */
#if defined __GNUC__
__attribute__((format(printf, 4, 5)))
#endif
Status report(const Instance *instance, Status status, const char *function, const char *format,
              ...);

/* Times, tolerance and start of initialization mode. */
Status set_experiment(Instance *instance, const char *function, bool tolerance_defined,
                      double tolerance, double start, bool stop_defined, double stop);
void end_initialization(Instance *instance, Mode next);

/* The variable to be read or written, or a place of NULL and a message. */
Variable readable(Instance *instance, const char *function, Type type, uint32_t reference);
Variable writable(Instance *instance, const char *function, Type type, uint32_t reference);

/* `n` values of one numeric type, arrays element by element, one variable after the other. Writing
 * checks first: a refused call has no effect. */
Status read_values(Instance *instance, const char *function, Type type, const uint32_t reference[],
                   size_t n_references, void *values, size_t n);
Status write_values(Instance *instance, const char *function, Type type,
                    const uint32_t reference[], size_t n_references, const void *values, size_t n);
Status read_texts(Instance *instance, const char *function, const uint32_t reference[],
                  size_t n_references, const char *values[], size_t n);
Status write_texts(Instance *instance, const char *function, const uint32_t reference[],
                   size_t n_references, const char *const values[], size_t n);

/* Derivatives of inputs and outputs with respect to time. */
Status set_input_derivatives(Instance *instance, const char *function, const uint32_t reference[],
                             size_t n, const int order[], const double value[]);
Status get_output_derivatives(Instance *instance, const char *function, const uint32_t reference[],
                              size_t n, const int order[], double value[]);

/* Saved states: one flat block each. */
Status save(Instance *instance, const char *function, void **block);
Status restore(Instance *instance, const char *function, const void *block);
size_t saved_size(void);
Status check_saved(const Instance *instance, const char *function, const void *block);
Status deserialize(Instance *instance, const char *function, const void *bytes, size_t size,
                   void **block);

/* Where they are not supported, every call on them is refused. */
Status no_saved_states(const Instance *instance, const char *function);

/* A step from `step->t` by `step->h`: checked and taken. The mode changes only if it fails; what
 * follows from a step that ends early is up to the version of FMI. */
Status take_step(Instance *instance, const char *function, Step *step);

#endif
