#ifndef {{ NAME }}_ROOT
#define {{ NAME }}_ROOT
/* The square root, correctly rounded; 0 of all that is not positive. By the processor where it has one and -fno-math-errno
   says that nobody asks for errno: else compilers add a call of the library. Otherwise bit by bit: the same result. */
#if defined(__NO_MATH_ERRNO__) && (defined(__SSE2__) || defined(__aarch64__) || defined(__riscv_flen){{ arm_fpu }})
static {{ name }}_real {{ name }}_root({{ name }}_real x) { return (x > {{ zero }}) ? {{ builtin_root }}(x) : {{ zero }}; }
#else
static {{ name }}_real {{ name }}_root({{ name }}_real x) {
  const {{ name }}_real twice = x + x;
  {{ name }}_real found = (x > {{ zero }}) ? x : {{ zero }}; /* infinity is its own root */
  if (x < twice) {
    {{ name }}_real low = x; /* x = low scale^2, 1 <= low < 4: steps of 4 are exact */
    {{ name }}_real scale = {{ one }};
    {{ name }}_real digit = {{ one }};
    bool large = low >= {{ four }};
    bool small = low < {{ one }};
    int32_t k;
    while (large) {
      low = low * {{ quarter }};
      scale = scale * {{ two }};
      large = low >= {{ four }};
    }
    while (small) {
      low = low * {{ four }};
      scale = scale * {{ half }};
      small = low < {{ one }};
    }
    /* Digit by digit: low = (x - found^2) / digit at every step, exactly where it counts. */
    found = {{ one }};
    low = low - {{ one }};
    for (k = 0; k < {{ digits }}; k++) {
      {{ name }}_real rest;
      digit = digit * {{ half }};
      rest = ({{ two }} * low) - ({{ two }} * found);
      low = low * {{ two }};
      if (rest >= digit) {
        low = rest - digit;
        found = found + digit;
      }
    }
    /* The next digit decides: a root is never half way between two numbers. */
    if (low > found) {
      found = found + digit;
    }
    found = found * scale;
  }
  return found;
}
#endif
#endif
