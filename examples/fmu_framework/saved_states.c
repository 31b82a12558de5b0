/* Saving and restoring the slave.
 *
 * An fmi2FMUstate is one flat block, a header and the slave's state, and serialising it is copying
 * it. The header tells a state of this model from one of another model, of another layout or of a
 * machine with another byte order: each is refused by name.
 */
#include "cosimulation_slave.h"

#include <stdlib.h>
#include <string.h>

enum { STATE_VERSION = 1 };
static const uint32_t STATE_MAGIC = 0x534c4156u; /* "SLAV" */

typedef struct {
    uint32_t magic, version;
    uint64_t size; /* bytes, header included */
    char model[32];
    SlaveState state;
} SavedState;

enum {
    HEADER_BYTES = 4 + 4 + 8 + 32,
    STATE_DOUBLES = 5 + MAX_STATES + (MAX_INPUT_ORDER + 1) * MAX_INPUTS + MAX_PARAMETERS
};

/* Does not compile if the compiler had to pad: padding would serialise as random bytes. */
typedef char no_padding[sizeof(SavedState) == HEADER_BYTES + STATE_DOUBLES * sizeof(double) + 2 * 4
                            ? 1
                            : -1];

/* Only whole states may be saved: what a failed step leaves behind is not one. */
enum {
    CAN_SAVE = INSTANTIATED | INITIALIZATION_MODE | STEP_COMPLETE | STEP_FAILED | TERMINATED,
    CAN_RESTORE = CAN_SAVE | ERROR
};

static void fill(SavedState *saved, const SlaveState *state)
{
    memset(saved, 0, sizeof *saved);
    saved->magic = STATE_MAGIC;
    saved->version = STATE_VERSION;
    saved->size = sizeof *saved;
    strncpy(saved->model, model.identifier, sizeof saved->model - 1);
    saved->state = *state;
}

/* fmi2OK if `saved` is a state of this model, else fmi2Error and a message. */
static fmi2Status check(const Slave *slave, const char *function, const SavedState *saved)
{
    SavedState own;
    fill(&own, &slave->state);
    if (saved->magic != own.magic)
        return report(slave, fmi2Error, function, "this is not a saved state of such a slave");
    if (saved->version != own.version)
        return report(slave, fmi2Error, function, "the saved state has version %u, expected %u",
                      (unsigned)saved->version, (unsigned)own.version);
    if (saved->size != own.size)
        return report(slave, fmi2Error, function, "the saved state says %llu bytes, expected %llu",
                      (unsigned long long)saved->size, (unsigned long long)own.size);
    if (memcmp(saved->model, own.model, sizeof own.model) != 0)
        return report(slave, fmi2Error, function,
                      "the saved state belongs to model '%.*s', expected '%s'",
                      (int)sizeof saved->model, saved->model, own.model);
    for (int mode = INSTANTIATED; mode <= TERMINATED; mode <<= 1)
        if (saved->state.mode == mode)
            return fmi2OK;
    return report(slave, fmi2Error, function, "the saved state is damaged: unknown mode %d",
                  (int)saved->state.mode);
}

/* Put a copy of `saved` where `FMUstate` points, into the block that is there already if any. */
static fmi2Status hand_out(const Slave *slave, const char *function, const SavedState *saved,
                           fmi2FMUstate *FMUstate)
{
    SavedState *block = *FMUstate;
    if (block && check(slave, function, block) != fmi2OK)
        return fmi2Error;
    if (!block && !(block = malloc(sizeof *block)))
        return report(slave, fmi2Error, function, "out of memory");
    memcpy(block, saved, sizeof *block);
    *FMUstate = block;
    return fmi2OK;
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    const Slave *slave = enter(c, __func__, CAN_SAVE);
    if (!slave)
        return fmi2Error;
    if (!FMUstate)
        return report(slave, fmi2Error, __func__, "FMUstate is NULL");
    SavedState saved;
    fill(&saved, &slave->state);
    return hand_out(slave, __func__, &saved, FMUstate);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    Slave *slave = enter(c, __func__, CAN_RESTORE);
    if (!slave)
        return fmi2Error;
    if (!FMUstate)
        return report(slave, fmi2Error, __func__, "FMUstate is NULL");
    const SavedState *saved = FMUstate;
    if (check(slave, __func__, saved) != fmi2OK)
        return fmi2Error;
    slave->state = saved->state;
    return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    if (!enter(c, __func__, CAN_RESTORE))
        return fmi2Error;
    if (FMUstate) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    const Slave *slave = enter(c, __func__, CAN_RESTORE);
    if (!slave)
        return fmi2Error;
    if (!FMUstate || !size)
        return report(slave, fmi2Error, __func__, "%s is NULL", FMUstate ? "size" : "FMUstate");
    if (check(slave, __func__, FMUstate) != fmi2OK)
        return fmi2Error;
    *size = sizeof(SavedState);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[],
                                 size_t size)
{
    const Slave *slave = enter(c, __func__, CAN_RESTORE);
    if (!slave)
        return fmi2Error;
    if (!FMUstate || !serializedState)
        return report(slave, fmi2Error, __func__, "%s is NULL",
                      FMUstate ? "serializedState" : "FMUstate");
    if (size < sizeof(SavedState))
        return report(slave, fmi2Error, __func__, "%llu bytes are too few for %llu",
                      (unsigned long long)size, (unsigned long long)sizeof(SavedState));
    if (check(slave, __func__, FMUstate) != fmi2OK)
        return fmi2Error;
    memcpy(serializedState, FMUstate, sizeof(SavedState));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate)
{
    const Slave *slave = enter(c, __func__, CAN_RESTORE);
    if (!slave)
        return fmi2Error;
    if (!serializedState || !FMUstate)
        return report(slave, fmi2Error, __func__, "%s is NULL",
                      serializedState ? "FMUstate" : "serializedState");
    SavedState saved;
    if (size != sizeof saved)
        return report(slave, fmi2Error, __func__, "the serialized state has %llu bytes, expected %llu",
                      (unsigned long long)size, (unsigned long long)sizeof saved);
    memcpy(&saved, serializedState, sizeof saved);
    if (check(slave, __func__, &saved) != fmi2OK)
        return fmi2Error;
    return hand_out(slave, __func__, &saved, FMUstate);
}
