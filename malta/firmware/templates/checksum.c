static uint32_t add_bits(uint32_t sum, {{ name }}_real value) {
  const {{ name }}_real plain = (value == {{ zero }}) ? {{ zero }} : value; /* -0 is 0 */
{% if precision == "double" %}
  uint64_t bits;
  uint64_t upper;
  uint32_t half;
  (void)memcpy(&bits, &plain, sizeof bits);
  upper = bits >> 32;
  half = (sum ^ (uint32_t)upper) * {{ fnv_factor }}u;
  return (half ^ (uint32_t)bits) * {{ fnv_factor }}u;
{% else %}
  uint32_t bits;
  (void)memcpy(&bits, &plain, sizeof bits);
  return (sum ^ bits) * {{ fnv_factor }}u;
{% endif %}
}

static uint32_t add_all(uint32_t begin, const {{ name }}_real values[], int32_t count) {
  uint32_t sum = begin;
  int32_t k;
  for (k = 0; k < count; k++) {
    sum = add_bits(sum, values[k]);
  }
  return sum;
}

static void take({{ name }}_real to[], const {{ name }}_real from[], int32_t *next, int32_t count) {
  int32_t k;
  for (k = 0; k < count; k++) {
    to[k] = from[*next + k];
  }
  *next = *next + count;
}
