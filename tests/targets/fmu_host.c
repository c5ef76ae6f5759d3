/* Steps an FMU (FMI 2.0, co-simulation) of one binary, and prints all its variables as the bits of doubles.
   host LIBRARY GUID VARIABLES STEP SAMPLES REFERENCE VALUE, where input REFERENCE is VALUE all the time. */
#include <stdio.h>
#include <stdlib.h>
#ifdef _WIN32
#include <windows.h>
static void *find(void *library, const char *name) { return (void *)GetProcAddress((HMODULE)library, name); }
static void *load(const char *path) { return (void *)LoadLibraryA(path); }
#else
#include <dlfcn.h>
static void *find(void *library, const char *name) { return dlsym(library, name); }
static void *load(const char *path) { return dlopen(path, RTLD_NOW); }
#endif
#include "fmi2Functions.h"

static void report(fmi2ComponentEnvironment e, fmi2String name, fmi2Status s, fmi2String kind, fmi2String text, ...) {
  (void)e;
  (void)s;
  fprintf(stderr, "%s: %s: %s\n", name, kind, text);
}

int main(int count, char **words) {
  void *library = count == 8 ? load(words[1]) : NULL;
  if (library == NULL) return 2;
  fmi2CallbackFunctions calls = { report, calloc, free, NULL, NULL };
  fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)find(library, "fmi2Instantiate");
  fmi2SetupExperimentTYPE *setup = (fmi2SetupExperimentTYPE *)find(library, "fmi2SetupExperiment");
  fmi2EnterInitializationModeTYPE *begin = (fmi2EnterInitializationModeTYPE *)find(library, "fmi2EnterInitializationMode");
  fmi2ExitInitializationModeTYPE *start = (fmi2ExitInitializationModeTYPE *)find(library, "fmi2ExitInitializationMode");
  fmi2SetRealTYPE *set = (fmi2SetRealTYPE *)find(library, "fmi2SetReal");
  fmi2GetRealTYPE *get = (fmi2GetRealTYPE *)find(library, "fmi2GetReal");
  fmi2DoStepTYPE *step = (fmi2DoStepTYPE *)find(library, "fmi2DoStep");
  fmi2FreeInstanceTYPE *end = (fmi2FreeInstanceTYPE *)find(library, "fmi2FreeInstance");
  fmi2Component unit = instantiate("unit", fmi2CoSimulation, words[2], "", &calls, fmi2False, fmi2False);
  const int variables = atoi(words[3]);
  const double period = atof(words[4]);
  const int samples = atoi(words[5]);
  const fmi2ValueReference input = (fmi2ValueReference)atoi(words[6]);
  const double value = atof(words[7]);
  if (unit == NULL || setup(unit, fmi2False, 0, 0, fmi2False, 0) || begin(unit) || start(unit)) return 3;
  for (int k = 0; k < samples; k++) {
    if (set(unit, &input, 1, &value) || step(unit, k * period, period, fmi2True)) return 4;
    for (fmi2ValueReference j = 0; j < (fmi2ValueReference)variables; j++) {
      union {
        double number;
        unsigned long long bits;
      } found;
      if (get(unit, &j, 1, &found.number)) return 5;
      printf("%016llx\n", found.bits);
    }
  }
  end(unit);
  return 0;
}
