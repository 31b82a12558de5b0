/* What an FMU of this collection does, apart from the version of FMI that it speaks.
 *
 * Everything that decides what the FMU does next lies in one block, the state, without pointers:
 * copying it is saving the FMU. What must not be saved (a thread, an open file) lies in a second
 * block, the hidden one. Each FMU defines one `behaviour`.
 */
#ifndef BEHAVIOUR_H
#define BEHAVIOUR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* By their names in FMI 3.0. A Real of FMI 1.0 and 2.0 is a FLOAT64, an Integer an INT32; an
 * enumeration is an INT32 in FMI 2.0 and an INT64 in FMI 3.0. */
typedef enum {
    FLOAT32,
    FLOAT64,
    INT8,
    UINT8,
    INT16,
    UINT16,
    INT32,
    UINT32,
    INT64,
    UINT64,
    BOOLEAN, /* bool */
    STRING,  /* char[TEXT_SIZE], terminated by 0 */
    BINARY,  /* Binary */
    CLOCK,   /* bool */
    TYPES
} Type;

enum { TEXT_SIZE = 128, BINARY_SIZE = 64 };

typedef struct {
    uint32_t size;
    uint8_t bytes[BINARY_SIZE];
} Binary;

typedef enum {
    READ_ONLY,
    START_VALUE, /* can be set until the end of initialization mode */
    INPUT_VALUE, /* can be set then and between steps */
    STRUCTURAL   /* can be set in configuration mode */
} Access;

typedef struct {
    void *place;  /* in the state; NULL: there is no such variable */
    size_t count; /* number of values, 1 for a scalar */
    Access access;
} Variable;

typedef enum {
    STEP_TAKEN,   /* up to `reached`, the end unless `event` is set */
    STEP_REFUSED, /* nothing has happened */
    STEP_FAILED   /* the state is spoilt */
} Outcome;

typedef struct Step {
    double t, h;        /* s: from t to t + h */
    double tolerance;   /* relative */
    double reached;     /* s; out, t + h beforehand */
    bool event;         /* out: an event at `reached` is to be handled before the next step */
    bool terminate;     /* out: the FMU wants the simulation to end at `reached` */
    const char *reason; /* out; of a step that is taken: a warning, or NULL */

    bool stop_at_events; /* false: handle them on the way */

    /* Asks the importer for the inputs at `time`, which then lie in the state; NULL: they stay. */
    void (*request_inputs)(const struct Step *step, double time);
    /* Tells the importer that the state belongs to `time`. Returns where the step has to end: a
     * time within `time` and t + h. NULL: nobody listens. */
    double (*finish_internal_step)(const struct Step *step, double time);
    void *importer;
} Step;

typedef struct {
    size_t state_size;  /* bytes */
    size_t hidden_size; /* bytes, 0 for none */

    /* Put the start values into `state`, which is all zeros beforehand. */
    void (*start)(void *state);
    Variable (*find)(void *state, Type type, uint32_t reference);

    /* All that follows may be NULL. */

    /* Returns how many scalar variables, from this one on, have value references that follow each
     * other, the same access and places side by side; so have their derivatives of each order.
     * NULL: each stands by itself. */
    size_t (*side_by_side)(Type type, uint32_t reference);

    /* Returns NULL, or why there is no instance. `resources`: folder or URI of the resources. */
    const char *(*open)(void *hidden, const char *resources);
    void (*close)(void *hidden);
    /* At the begin of a function of FMI between them. Returns NULL, or why it fails. */
    const char *(*enter)(const char *function);

    /* At the end of configuration mode: NULL, or why the structural parameters cannot be so. */
    const char *(*check_structure)(const void *state);
    /* At the end of initialization mode. */
    void (*initialized)(void *state, double time);
    /* Bring everything that is calculated up to date. */
    void (*calculate)(void *state, double time);

    /* Co-simulation. */
    Outcome (*step)(void *state, void *hidden, Step *step);
    /* Where the derivative of this order of an input is stored, NULL if there is none. */
    double *(*input_derivative)(void *state, uint32_t reference, int order);
    /* Returns false if there is no such derivative. */
    bool (*output_derivative)(void *state, double time, uint32_t reference, int order,
                              double *value);

    /* Called with the block of the state that is to be restored. Returns NULL or why it cannot be.
     * NULL: the block is copied back. */
    const char *(*restore)(void *state, void *hidden, const void *saved);

    /* Model exchange. */
    int continuous_states, event_indicators;
    double *(*continuous_state)(void *state); /* the first of them, the others follow */
    const double *nominals;
    void (*derivatives)(void *state, double time, double dx[]);
    void (*indicators)(void *state, double time, double z[]);

    /* Handle the event at `time`; both interfaces. Returns whether continuous states have jumped.
     * `next`: the time of the next time event, INFINITY if there is none. */
    bool (*update)(void *state, double time, double *next);
} Behaviour;

extern const Behaviour behaviour;

#endif
