#include <math.h>

/* a b + c, rounded once. Where no instruction does it, the library's takes a hundred times as long: on purpose only. */
#if defined({{ NAME }}_SLOW_FMA) || defined(__FMA__) || defined(__aarch64__)
#elif {{ "!defined(__FP_FAST_FMA) && !defined(FP_FAST_FMA)" if precision == "double" else "!defined(__FP_FAST_FMAF) && !defined(FP_FAST_FMAF)" }}
#error "the target has no fused multiply-add: compile for one (-mfma), export without, or define {{ NAME }}_SLOW_FMA"
#endif
#ifndef {{ NAME }}_FMA
#define {{ NAME }}_FMA
static {{ name }}_real {{ name }}_fma({{ name }}_real a, {{ name }}_real b, {{ name }}_real c) { return {{ library_fma }}(a, b, c); }
#endif
