/* A specimen as a co-simulation unit of FMI 3.0, around the compiled step of its solver.

unit.h defines IDENTITY, STEP_S, OUT_SIZE, and of the solver its state at `rest` and `constants`.
*/
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include "unit.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
enum { OK = 0, ERROR = 3 };
enum { TIME, ACCELERATION, DISPLACEMENT, OUTPUTS, VARIABLES = OUTPUTS + 5 }; /* value references */
typedef void (*Log)(void *, int, const char *, const char *);
typedef struct {
    double state[sizeof rest / sizeof *rest], values[VARIABLES], before[OUTPUTS]; /* before: inputs of the last step */
    void *environment;
    Log log;
} Unit;

/* One step, compiled by numba: 0, or a status where it failed. */
int advance(
    void *result, void *error, double *state, const double *constants, double *inputs, double *out);

/* What compiled code refers to and never calls: it allocates nothing. */
void NRT_Free(void *memory) { abort(); }
void NRT_MemInfo_call_dtor(void *memory) { abort(); }

static int refuse(Unit *unit, const char *reason) {
    if (unit->log) unit->log(unit->environment, ERROR, "logStatusError", reason);
    return ERROR;
}

EXPORT const char *fmi3GetVersion(void) { return "3.0"; }
EXPORT int fmi3SetDebugLogging(Unit *unit, bool on, size_t count, const char *const *categories) { return OK; }
EXPORT int fmi3Reset(Unit *unit) {
    memcpy(unit->state, rest, sizeof rest);
    memset(unit->values, 0, sizeof unit->values);
    memset(unit->before, 0, sizeof unit->before);
    return OK;
}
EXPORT Unit *fmi3InstantiateCoSimulation(
    const char *name, const char *token, const char *resources, bool visible, bool logging, bool events, bool early,
    const uint32_t *intermediate, size_t count, void *environment, Log log, void *update) {
    Unit *unit = calloc(1, sizeof *unit);
    if (!unit) return NULL;
    unit->environment = environment;
    unit->log = log;
    fmi3Reset(unit);
    if (token && !strcmp(token, IDENTITY)) return unit;
    refuse(unit, "the instantiation token is that of another unit");
    free(unit);
    return NULL;
}
EXPORT void fmi3FreeInstance(Unit *unit) { free(unit); }
EXPORT int fmi3EnterInitializationMode(Unit *unit, bool limited, double tolerance, double start, bool ends, double stop) {
    unit->values[TIME] = start;
    return OK;
}
EXPORT int fmi3ExitInitializationMode(Unit *unit) { return OK; }
EXPORT int fmi3Terminate(Unit *unit) { return OK; }
EXPORT int fmi3GetFloat64(Unit *unit, const uint32_t *references, size_t count, double *values, size_t size) {
    for (size_t k = 0; k < count; k++) {
        if (references[k] >= VARIABLES) return refuse(unit, "no variable has this value reference");
        values[k] = unit->values[references[k]];
    }
    return OK;
}
EXPORT int fmi3SetFloat64(Unit *unit, const uint32_t *references, size_t count, const double *values, size_t size) {
    for (size_t k = 0; k < count; k++) {
        if (references[k] == TIME || references[k] >= OUTPUTS) return refuse(unit, "only inputs can be set");
        unit->values[references[k]] = values[k];
    }
    return OK;
}
EXPORT int fmi3DoStep(
    Unit *unit, double now, double size, bool keeps, bool *event, bool *terminate, bool *early, double *last) {
    double out[OUT_SIZE], *values = unit->values, count = rint(size / STEP_S);
    void *result = NULL, *error = NULL;
    *event = *terminate = *early = false;
    *last = now;
    if (!(count >= 1 && fabs(size - count * STEP_S) <= 1e-6 * STEP_S))
        return refuse(unit, "a communication step must be a whole multiple of fixedInternalStepSize");
    for (double k = 1; k <= count; k++) { /* inputs are linear within a step */
        double share = k / count, inputs[OUTPUTS];
        for (int i = ACCELERATION; i < OUTPUTS; i++)
            inputs[i] = k < count ? unit->before[i] + share * (values[i] - unit->before[i]) : values[i];
        int status = advance(&result, &error, unit->state, constants, inputs + ACCELERATION, out);
        if (status || !isfinite(out[0]))
            return refuse(unit, "the motion of the specimen is not finite");
    }
    memcpy(unit->before, values, sizeof unit->before);
    memcpy(values + OUTPUTS, out, (VARIABLES - OUTPUTS) * sizeof *out);
    *last = values[TIME] = now + size;
    return OK;
}

#define ABSENT(name) EXPORT int fmi3##name(void) { return ERROR; }
#define ABSENT_INSTANCE(name) EXPORT void *fmi3##name(void) { return NULL; }
#define BOTH(name) ABSENT(Get##name) ABSENT(Set##name)
ABSENT_INSTANCE(InstantiateModelExchange) ABSENT_INSTANCE(InstantiateScheduledExecution)
BOTH(Float32) BOTH(Int8) BOTH(UInt8) BOTH(Int16) BOTH(UInt16) BOTH(Int32) BOTH(UInt32) BOTH(Int64) BOTH(UInt64)
BOTH(Boolean) BOTH(String) BOTH(Binary) BOTH(Clock) BOTH(FMUState) BOTH(IntervalDecimal) BOTH(IntervalFraction)
BOTH(ShiftDecimal) BOTH(ShiftFraction) ABSENT(EnterEventMode) ABSENT(GetNumberOfVariableDependencies)
ABSENT(GetVariableDependencies) ABSENT(FreeFMUState) ABSENT(SerializedFMUStateSize) ABSENT(SerializeFMUState)
ABSENT(DeserializeFMUState) ABSENT(GetDirectionalDerivative) ABSENT(GetAdjointDerivative)
ABSENT(EnterConfigurationMode) ABSENT(ExitConfigurationMode) ABSENT(EvaluateDiscreteStates)
ABSENT(UpdateDiscreteStates) ABSENT(EnterContinuousTimeMode) ABSENT(CompletedIntegratorStep) ABSENT(SetTime)
ABSENT(SetContinuousStates) ABSENT(GetContinuousStateDerivatives) ABSENT(GetEventIndicators)
ABSENT(GetContinuousStates) ABSENT(GetNominalsOfContinuousStates) ABSENT(GetNumberOfEventIndicators)
ABSENT(GetNumberOfContinuousStates) ABSENT(EnterStepMode) ABSENT(GetOutputDerivatives) ABSENT(ActivateModelPartition)
