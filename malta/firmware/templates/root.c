#ifndef {{ NAME }}_ROOT
#define {{ NAME }}_ROOT
/* The square root, correctly rounded: by the processor where it has one, else bit by bit. */
#if defined(__SSE2__) || defined(__aarch64__) || defined(__riscv_flen){{ arm_fpu }}
static {{ name }}_real {{ name }}_root({{ name }}_real x) { return {{ builtin_root }}(x); }
#else
static {{ name }}_real {{ name }}_root({{ name }}_real x) {
  {{ name }}_real low = x;
  {{ name }}_real scale = {{ one }};
  {{ name }}_real found = {{ zero }};
  {{ name }}_real digit = {{ one }};
  int32_t k;
  if (!(x > {{ zero }})) {
    return {{ zero }};
  }
  while (low >= {{ four }}) { /* x = low scale^2 with 1 <= low < 4: steps of 4 are exact */
    low = low * {{ quarter }};
    scale = scale * {{ two }};
  }
  while (low < {{ one }}) {
    low = low * {{ four }};
    scale = scale * {{ half }};
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
  return found * scale;
}
#endif
#endif
