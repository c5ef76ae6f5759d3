/* {{ title }}: the functions of FMI 2.0 for co-simulation around unit.c. Written by malta {{ version }}. */
#include <stdlib.h>
#include <string.h>

#include "fmi2Functions.h"
#include "unit.h"

typedef struct {
  unit_data data;
  fmi2CallbackLogger log;
  fmi2ComponentEnvironment environment;
  char *name;
} instance;

static fmi2Status answer(const instance *i, int status, const char *message) {
  if ((status != UNIT_OK) && (i->log != NULL) && (message != NULL)) {
    i->log(i->environment, i->name, (fmi2Status)status, (status == UNIT_ERROR) ? "logStatusError" : "logStatusWarning",
           "%s", message);
  }
  return (fmi2Status)status;
}

static fmi2Status refuse(fmi2Component c, const char *message) {
  return answer((const instance *)c, UNIT_ERROR, message);
}

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories, const fmi2String categories[]) {
  (void)c;
  (void)loggingOn; /* warnings and errors are always said, and there is nothing else */
  (void)nCategories;
  (void)categories;
  return fmi2OK;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean loggingOn) {
  const char *name = (instanceName == NULL) ? "" : instanceName;
  instance *i = (instance *)calloc(1, sizeof *i);
  (void)fmuResourceLocation;
  (void)visible;
  (void)loggingOn;
  if (i == NULL) {
    return NULL;
  }
  i->name = (char *)calloc(strlen(name) + 1, 1);
  if (i->name == NULL) {
    free(i);
    return NULL;
  }
  memcpy(i->name, name, strlen(name));
  if (functions != NULL) {
    i->log = functions->logger;
    i->environment = functions->componentEnvironment;
  }
  unit_reset(&i->data);
  if ((fmuType != fmi2CoSimulation) || (fmuGUID == NULL) || (strcmp(fmuGUID, UNIT_TOKEN) != 0)) {
    (void)refuse(i, "an instance of another kind or with another GUID than the unit's own");
    fmi2FreeInstance(i);
    return NULL;
  }
  return i;
}

void fmi2FreeInstance(fmi2Component c) {
  if (c != NULL) {
    free(((instance *)c)->name);
    free(c);
  }
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
  instance *i = (instance *)c;
  (void)toleranceDefined;
  (void)tolerance;
  (void)stopTimeDefined;
  (void)stopTime;
  if (i->data.phase != UNIT_NEW) {
    return refuse(c, "an initialization after the start");
  }
  i->data.value[0] = startTime;
  return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_begin(&i->data, i->data.value[0], &message);
  return answer(i, status, message);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_finish_beginning(&i->data, &message);
  return answer(i, status, message);
}

fmi2Status fmi2Terminate(fmi2Component c) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_end(&i->data, &message);
  return answer(i, status, message);
}

fmi2Status fmi2Reset(fmi2Component c) {
  unit_reset(&((instance *)c)->data);
  return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[]) {
  instance *i = (instance *)c;
  const char *message = NULL;
  int status = UNIT_OK;
  size_t k;
  for (k = 0; (k < nvr) && (status == UNIT_OK); k++) {
    status = unit_get(&i->data, vr[k], &value[k], &message);
  }
  return answer(i, status, message);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[]) {
  instance *i = (instance *)c;
  const char *message = NULL;
  int status = UNIT_OK;
  size_t k;
  for (k = 0; (k < nvr) && (status == UNIT_OK); k++) {
    status = unit_set(&i->data, vr[k], value[k], &message);
  }
  return answer(i, status, message);
}
{% for kind in ("Integer", "Boolean", "String") %}
{% for verb, value in (("Get", "fmi2" ~ kind), ("Set", "const fmi2" ~ kind)) %}

fmi2Status fmi2{{ verb }}{{ kind }}(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, {{ value }} value[]) {
  (void)vr;
  (void)value;
  return (nvr == 0) ? fmi2OK : refuse(c, "all variables are of type Real");
}
{% endfor %}
{% endfor %}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
  if (*FMUstate == NULL) {
    *FMUstate = malloc(sizeof(unit_data));
  }
  if (*FMUstate == NULL) {
    return refuse(c, "no memory for a state");
  }
  memcpy(*FMUstate, &((instance *)c)->data, sizeof(unit_data));
  return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
  if (FMUstate == NULL) {
    return refuse(c, "no state");
  }
  memcpy(&((instance *)c)->data, FMUstate, sizeof(unit_data));
  return fmi2OK;
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
  (void)c;
  if (FMUstate != NULL) {
    free(*FMUstate);
    *FMUstate = NULL;
  }
  return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
  (void)c;
  (void)FMUstate;
  *size = unit_bytes();
  return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size) {
  if ((FMUstate == NULL) || (size < unit_bytes())) {
    return refuse(c, "no state, or too little memory for it");
  }
  unit_write((const unit_data *)FMUstate, (unsigned char *)serializedState);
  return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size, fmi2FMUstate *FMUstate) {
  const instance *i = (const instance *)c;
  const char *message = "a state of another size";
  fmi2FMUstate state = NULL;
  int status = UNIT_ERROR;
  if (size != unit_bytes()) {
    return refuse(c, message);
  }
  state = malloc(sizeof(unit_data));
  if (state == NULL) {
    return refuse(c, "no memory for a state");
  }
  status = unit_read((unit_data *)state, (const unsigned char *)serializedState, &message);
  if (status == UNIT_OK) {
    free(*FMUstate);
    *FMUstate = state;
  } else {
    free(state);
  }
  return answer(i, status, message);
}

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
  (void)vUnknown_ref;
  (void)nUnknown;
  (void)vKnown_ref;
  (void)nKnown;
  (void)dvKnown;
  (void)dvUnknown;
  return refuse(c, "derivatives are not provided");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
  (void)vr;
  (void)nvr;
  (void)order;
  (void)value;
  return refuse(c, "inputs are held between samples");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
  (void)vr;
  (void)nvr;
  (void)order;
  (void)value;
  return refuse(c, "derivatives of outputs are not provided");
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
  instance *i = (instance *)c;
  const char *message = NULL;
  const int status = unit_advance(&i->data, currentCommunicationPoint, communicationStepSize, &message);
  (void)noSetFMUStatePriorToCurrentPoint;
  return answer(i, status, message);
}

fmi2Status fmi2CancelStep(fmi2Component c) { return refuse(c, "no step is under way: steps end before they return"); }

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
  if (s != fmi2LastSuccessfulTime) {
    return fmi2Discard;
  }
  *value = ((const instance *)c)->data.value[0];
  return fmi2OK;
}
{% for kind, value in (("", "fmi2Status"), ("Integer", "fmi2Integer"), ("Boolean", "fmi2Boolean"), ("String", "fmi2String")) %}

fmi2Status fmi2Get{{ kind }}Status(fmi2Component c, const fmi2StatusKind s, {{ value }} *value) {
  (void)c;
  (void)s;
  (void)value;
  return fmi2Discard; /* steps end before they return */
}
{% endfor %}
