#include <float.h>

/* No contraction, whatever the compiler is told: a product and a sum round twice. */
#if defined(__clang__)
#pragma STDC FP_CONTRACT OFF
#elif defined(__GNUC__)
#pragma GCC optimize("fp-contract=off")
#if defined(__FMA__) || defined(__FMA4__) /* gcc 12 fuses products and alternating sums of vectors all the same */
#pragma GCC optimize("no-tree-vectorize")
#endif
#endif

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ != 0))
#error "compile without fast mathematics"
#endif
#if defined(FLT_EVAL_METHOD) && (FLT_EVAL_METHOD != 0) && (FLT_EVAL_METHOD != 16) /* 16: numbers of 16 bits beside it */
#error "a processor is needed that computes in the precision of its numbers"
#endif
