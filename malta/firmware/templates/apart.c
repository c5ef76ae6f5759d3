#ifndef {{ NAME }}_APART
/* Long loops stay functions of their own: in one function with all, their numbers push those of others out of registers. */
#if defined(__GNUC__)
#define {{ NAME }}_APART __attribute__((noinline))
#else
#define {{ NAME }}_APART
#endif
#endif
