/* {{ title }}: the functions of FMI 3.0 for co-simulation around unit.c. Written by malta {{ version }}. */
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "unit.h"

typedef struct {
  unit_data data;
  fmi3LogMessageCallback log;
  fmi3InstanceEnvironment environment;
} instance;

static fmi3Status answer(const instance *i, int status, const char *message) {
  if ((status != UNIT_OK) && (i->log != NULL) && (message != NULL)) {
    i->log(i->environment, (fmi3Status)status, (status == UNIT_ERROR) ? "logStatusError" : "logStatusWarning", message);
  }
  return (fmi3Status)status;
}

static fmi3Status refuse(fmi3Instance i, const char *message) {
  return answer((const instance *)i, UNIT_ERROR, message);
}

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean loggingOn, size_t nCategories, const fmi3String categories[]) {
  (void)i;
  (void)loggingOn; /* warnings and errors are always said, and there is nothing else */
  (void)nCategories;
  (void)categories;
  return fmi3OK;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
                                         fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
                                         fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate) {
  instance *i = (instance *)calloc(1, sizeof *i);
  (void)instanceName;
  (void)resourcePath;
  (void)visible;
  (void)loggingOn;
  (void)earlyReturnAllowed;
  (void)requiredIntermediateVariables;
  (void)intermediateUpdate;
  if (i == NULL) {
    return NULL;
  }
  i->log = logMessage;
  i->environment = instanceEnvironment;
  unit_reset(&i->data);
  if ((instantiationToken == NULL) || (strcmp(instantiationToken, UNIT_TOKEN) != 0) || eventModeUsed ||
      (nRequiredIntermediateVariables != 0)) {
    (void)refuse(i, "an instance with another token, with an event mode or with intermediate variables");
    free(i);
    return NULL;
  }
  return i;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
                                          fmi3Boolean visible, fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
  (void)instanceName;
  (void)instantiationToken;
  (void)resourcePath;
  (void)visible;
  (void)loggingOn;
  (void)instanceEnvironment;
  (void)logMessage;
  return NULL;
}

fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String instantiationToken,
                                               fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                               fmi3InstanceEnvironment instanceEnvironment,
                                               fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
                                               fmi3LockPreemptionCallback lockPreemption,
                                               fmi3UnlockPreemptionCallback unlockPreemption) {
  (void)instanceName;
  (void)instantiationToken;
  (void)resourcePath;
  (void)visible;
  (void)loggingOn;
  (void)instanceEnvironment;
  (void)logMessage;
  (void)clockUpdate;
  (void)lockPreemption;
  (void)unlockPreemption;
  return NULL;
}

void fmi3FreeInstance(fmi3Instance i) { free(i); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance c, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_begin(&i->data, startTime, &message);
  (void)toleranceDefined;
  (void)tolerance;
  (void)stopTimeDefined;
  (void)stopTime;
  return answer(i, status, message);
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance c) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_finish_beginning(&i->data, &message);
  return answer(i, status, message);
}

fmi3Status fmi3Terminate(fmi3Instance c) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_end(&i->data, &message);
  return answer(i, status, message);
}

fmi3Status fmi3Reset(fmi3Instance c) {
  unit_reset(&((instance *)c)->data);
  return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance c, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues) {
  instance *i = (instance *)c;
  const char *message = "as many values as value references are needed";
  int status = (nValues == nValueReferences) ? UNIT_OK : UNIT_ERROR;
  size_t k;
  for (k = 0; (k < nValueReferences) && (status == UNIT_OK); k++) {
    status = unit_get(&i->data, valueReferences[k], &values[k], &message);
  }
  return answer(i, status, message);
}

fmi3Status fmi3SetFloat64(fmi3Instance c, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues) {
  instance *i = (instance *)c;
  const char *message = "as many values as value references are needed";
  int status = (nValues == nValueReferences) ? UNIT_OK : UNIT_ERROR;
  size_t k;
  for (k = 0; (k < nValueReferences) && (status == UNIT_OK); k++) {
    status = unit_set(&i->data, valueReferences[k], values[k], &message);
  }
  return answer(i, status, message);
}
{% for kind in ("Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64", "UInt64", "Boolean", "String") %}
{% for verb, value in (("Get", "fmi3" ~ kind), ("Set", "const fmi3" ~ kind)) %}

fmi3Status fmi3{{ verb }}{{ kind }}(fmi3Instance i, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          {{ value }} values[], size_t nValues) {
  (void)valueReferences;
  (void)values;
  (void)nValues;
  return (nValueReferences == 0) ? fmi3OK : refuse(i, "all variables are of type Float64");
}
{% endfor %}
{% endfor %}
{% for verb, constant in (("Get", ""), ("Set", "const ")) %}

fmi3Status fmi3{{ verb }}Binary(fmi3Instance i, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                         {{ constant }}size_t valueSizes[], {{ constant }}fmi3Binary values[], size_t nValues) {
  (void)valueReferences;
  (void)valueSizes;
  (void)values;
  (void)nValues;
  return (nValueReferences == 0) ? fmi3OK : refuse(i, "all variables are of type Float64");
}

fmi3Status fmi3{{ verb }}Clock(fmi3Instance i, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        {{ constant }}fmi3Clock values[]) {
  (void)valueReferences;
  (void)values;
  return (nValueReferences == 0) ? fmi3OK : refuse(i, "there are no clocks");
}
{% endfor %}

fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *FMUState) {
  if (*FMUState == NULL) {
    *FMUState = malloc(sizeof(unit_data));
  }
  if (*FMUState == NULL) {
    return refuse(i, "no memory for a state");
  }
  memcpy(*FMUState, &((instance *)i)->data, sizeof(unit_data));
  return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState FMUState) {
  if (FMUState == NULL) {
    return refuse(i, "no state");
  }
  memcpy(&((instance *)i)->data, FMUState, sizeof(unit_data));
  return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *FMUState) {
  (void)i;
  if (FMUState != NULL) {
    free(*FMUState);
    *FMUState = NULL;
  }
  return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState FMUState, size_t *size) {
  (void)i;
  (void)FMUState;
  *size = unit_bytes();
  return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size) {
  if ((FMUState == NULL) || (size < unit_bytes())) {
    return refuse(i, "no state, or too little memory for it");
  }
  unit_write((const unit_data *)FMUState, (unsigned char *)serializedState);
  return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte serializedState[], size_t size, fmi3FMUState *FMUState) {
  const char *message = "a state of another size";
  fmi3FMUState state = NULL;
  int status = UNIT_ERROR;
  if (size != unit_bytes()) {
    return refuse(i, message);
  }
  state = malloc(sizeof(unit_data));
  if (state == NULL) {
    return refuse(i, "no memory for a state");
  }
  status = unit_read((unit_data *)state, (const unsigned char *)serializedState, &message);
  if (status == UNIT_OK) {
    free(*FMUState);
    *FMUState = state;
  } else {
    free(state);
  }
  return answer((const instance *)i, status, message);
}

fmi3Status fmi3DoStep(fmi3Instance c, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_advance(&i->data, currentCommunicationPoint, communicationStepSize, &message);
  (void)noSetFMUStatePriorToCurrentPoint;
  *eventHandlingNeeded = fmi3False;
  *terminateSimulation = fmi3False;
  *earlyReturn = fmi3False;
  *lastSuccessfulTime = i->data.value[0];
  return answer(i, status, message);
}
{% set refs = "const fmi3ValueReference valueReferences[]" %}
{% for name, arguments in (
  ("EnterEventMode", ()),
  ("EnterConfigurationMode", ()),
  ("ExitConfigurationMode", ()),
  ("EnterStepMode", ()),
  ("EvaluateDiscreteStates", ()),
  ("GetNumberOfVariableDependencies", ("fmi3ValueReference valueReference", "size_t *nDependencies")),
  ("GetVariableDependencies", ("fmi3ValueReference dependent", "size_t elementIndicesOfDependent[]",
    "fmi3ValueReference independents[]", "size_t elementIndicesOfIndependents[]",
    "fmi3DependencyKind dependencyKinds[]", "size_t nDependencies")),
  ("GetDirectionalDerivative", ("const fmi3ValueReference unknowns[]", "size_t nUnknowns",
    "const fmi3ValueReference knowns[]", "size_t nKnowns", "const fmi3Float64 seed[]", "size_t nSeed",
    "fmi3Float64 sensitivity[]", "size_t nSensitivity")),
  ("GetAdjointDerivative", ("const fmi3ValueReference unknowns[]", "size_t nUnknowns",
    "const fmi3ValueReference knowns[]", "size_t nKnowns", "const fmi3Float64 seed[]", "size_t nSeed",
    "fmi3Float64 sensitivity[]", "size_t nSensitivity")),
  ("GetIntervalDecimal", (refs, "size_t nValueReferences", "fmi3Float64 intervals[]",
    "fmi3IntervalQualifier qualifiers[]")),
  ("GetIntervalFraction", (refs, "size_t nValueReferences", "fmi3UInt64 counters[]", "fmi3UInt64 resolutions[]",
    "fmi3IntervalQualifier qualifiers[]")),
  ("GetShiftDecimal", (refs, "size_t nValueReferences", "fmi3Float64 shifts[]")),
  ("GetShiftFraction", (refs, "size_t nValueReferences", "fmi3UInt64 counters[]", "fmi3UInt64 resolutions[]")),
  ("SetIntervalDecimal", (refs, "size_t nValueReferences", "const fmi3Float64 intervals[]")),
  ("SetIntervalFraction", (refs, "size_t nValueReferences", "const fmi3UInt64 counters[]",
    "const fmi3UInt64 resolutions[]")),
  ("SetShiftDecimal", (refs, "size_t nValueReferences", "const fmi3Float64 shifts[]")),
  ("SetShiftFraction", (refs, "size_t nValueReferences", "const fmi3UInt64 counters[]",
    "const fmi3UInt64 resolutions[]")),
  ("UpdateDiscreteStates", ("fmi3Boolean *discreteStatesNeedUpdate", "fmi3Boolean *terminateSimulation",
    "fmi3Boolean *nominalsOfContinuousStatesChanged", "fmi3Boolean *valuesOfContinuousStatesChanged",
    "fmi3Boolean *nextEventTimeDefined", "fmi3Float64 *nextEventTime")),
  ("EnterContinuousTimeMode", ()),
  ("CompletedIntegratorStep", ("fmi3Boolean noSetFMUStatePriorToCurrentPoint", "fmi3Boolean *enterEventMode",
    "fmi3Boolean *terminateSimulation")),
  ("SetTime", ("fmi3Float64 time",)),
  ("SetContinuousStates", ("const fmi3Float64 continuousStates[]", "size_t nContinuousStates")),
  ("GetContinuousStateDerivatives", ("fmi3Float64 derivatives[]", "size_t nContinuousStates")),
  ("GetEventIndicators", ("fmi3Float64 eventIndicators[]", "size_t nEventIndicators")),
  ("GetContinuousStates", ("fmi3Float64 continuousStates[]", "size_t nContinuousStates")),
  ("GetNominalsOfContinuousStates", ("fmi3Float64 nominals[]", "size_t nContinuousStates")),
  ("GetNumberOfEventIndicators", ("size_t *nEventIndicators",)),
  ("GetNumberOfContinuousStates", ("size_t *nContinuousStates",)),
  ("ActivateModelPartition", ("fmi3ValueReference clockReference", "fmi3Float64 activationTime")),
  ("GetOutputDerivatives", (refs, "size_t nValueReferences", "const fmi3Int32 orders[]", "fmi3Float64 values[]",
    "size_t nValues")),
) %}

fmi3Status fmi3{{ name }}(fmi3Instance i{% for text in arguments %}, {{ text }}{% endfor %}) {
{% for text in arguments %}
  (void){{ text.split()[-1].strip("*[]") }};
{% endfor %}
  return refuse(i, "fmi3{{ name }} is not provided");
}
{% endfor %}
