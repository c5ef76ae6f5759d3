/* {{ title }}: parameters that the target may change: see {{ name }}.h. Written by malta {{ version }}. */
#include "{{ name }}.h"

#include <limits.h>
#include <stdbool.h>
{% include "exact.c" %}

#define ROWS {{ rows | length }} /* of the table of monitors */
{% macro record(title, key, counts, checksum) %}
{{ title }} = {
{% for p in parameters %}
  { {{ p[key] }} }, /* {{ p.name }} */
{% endfor %}
  { {{ counts }} }, /* samples */
  {{ checksum }}
};
{% endmacro %}

{{ record("const " ~ name ~ "_parameters " ~ name ~ "_default_parameters", "values", counts, parameter_checksum) }}
{{ record("static const " ~ name ~ "_parameters least", "least", ones, "0u") }}
{{ record("static const " ~ name ~ "_parameters most", "most", counts, "0u") -}}

/* FNV-1a over bytes of 8 bits, those of a memory cell from the lowest on. */
static uint32_t fold(uint32_t sum, uint32_t cell) {
  uint32_t found = sum;
  int32_t shift;
  for (shift = 0; shift < CHAR_BIT; shift += 8) {
    found = (found ^ ((cell >> (uint32_t)shift) & 0xFFu)) * {{ fnv.factor }};
  }
  return found;
}

/* The same of numbers, each from its lowest byte on: of 1, that byte is zero. */
static uint32_t fold_reals(uint32_t sum, const {{ name }}_real values[], int32_t count) {
  const {{ name }}_real unity = {{ unity }};
  const bool is_little = *(const unsigned char *)&unity == 0u;
  const int32_t size = (int32_t)sizeof unity;
  uint32_t found = sum;
  int32_t k;
  for (k = 0; k < count; k++) {
    const unsigned char *cells = (const unsigned char *)&values[k];
    int32_t j;
    for (j = 0; j < size; j++) {
      found = fold(found, cells[is_little ? j : ((size - 1) - j)]);
    }
  }
  return found;
}

uint32_t {{ name }}_checksum(const {{ name }}_parameters *p) {
  uint32_t found = {{ fnv.start }};
  int32_t k;
{% for p in parameters %}
  found = fold_reals(found, p->{{ p.name }}, {{ p.size }});
{% endfor %}
  for (k = 0; k < ROWS; k++) {
    const uint32_t count = (uint32_t)p->samples[k];
    uint32_t j;
    for (j = 0u; j < 4u; j++) {
      found = (found ^ ((count >> (8u * j)) & 0xFFu)) * {{ fnv.factor }};
    }
  }
  return found;
}

/* A NaN is in no interval. */
static bool are_between(const {{ name }}_real values[], const {{ name }}_real low[], const {{ name }}_real high[], int32_t count) {
  bool inside = true;
  int32_t k;
  for (k = 0; k < count; k++) {
    inside = inside && (values[k] >= low[k]) && (values[k] <= high[k]);
  }
  return inside;
}

{% if factors %}
/* Whether gains are those of the gain file times one factor for each axis, which the first entry of K tells. */
static bool have_factors(const {{ name }}_parameters *p) {
  static const int32_t firsts[{{ axis_count }}] = { {{ first_entries }} };
{% for f in factors %}
  static const int32_t axes_of_{{ f.name }}[{{ f.size }}] = { {{ f.axes }} };
{% endfor %}
  bool same = true;
  int32_t k;
{% for f in factors %}
  for (k = 0; k < {{ f.size }}; k++) {
    const int32_t first = firsts[axes_of_{{ f.name }}[k]];
    const {{ name }}_real own = {{ name }}_default_parameters.{{ f.name }}[k];
    const {{ name }}_real factor = p->K[first] / {{ name }}_default_parameters.K[first];
    const {{ name }}_real wanted = factor * own;
    const {{ name }}_real apart = p->{{ f.name }}[k] - wanted;
    const {{ name }}_real rounding = {{ same }} * ((own < {{ nought }}) ? -own : own);
    same = same && (apart <= rounding) && (apart >= -rounding);
  }
{% endfor %}
  return same;
}

{% endif %}
int32_t {{ name }}_accepts_parameters(const {{ name }}_parameters *p) {
  bool accepted = p->checksum == {{ name }}_checksum(p);
  int32_t k;
{% for p in parameters %}
  accepted = accepted && are_between(p->{{ p.name }}, least.{{ p.name }}, most.{{ p.name }}, {{ p.size }});
{% endfor %}
  for (k = 0; k < ROWS; k++) {
    accepted = accepted && (p->samples[k] >= least.samples[k]) && (p->samples[k] <= most.samples[k]);
  }
{% if factors %}
  accepted = accepted && have_factors(p);
{% endif %}
  return accepted ? 1 : 0;
}

int32_t {{ name }}_set_parameters({{ name }}_state *s, const {{ name }}_parameters *p) {
  const int32_t accepted = {{ name }}_accepts_parameters(p);
  if (accepted == 1) {
    s->parameters = p;
  }
  return accepted;
}
