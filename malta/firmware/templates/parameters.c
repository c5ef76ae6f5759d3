/* {{ title }}: parameters that the target may change: see {{ name }}.h. Written by malta {{ version }}. */
#include "{{ name }}.h"

#include <limits.h>
#include <stdbool.h>
#include <stddef.h>
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

/* The first of so many numbers that is not in its interval, from `at` on in the record; -1: none. A NaN is in no interval. */
static int32_t first_outside(const {{ name }}_real values[], const {{ name }}_real low[], const {{ name }}_real high[], int32_t count,
                             int32_t at) {
  int32_t found = -1;
  int32_t k;
  for (k = count - 1; k >= 0; k--) {
    if (!((values[k] >= low[k]) && (values[k] <= high[k]))) {
      found = at + k;
    }
  }
  return found;
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
/* The first number of a record that is out of its range, in the order of the record; -1: none. */
static int32_t out_of_range(const {{ name }}_parameters *p) {
  {{ record("static const " ~ name ~ "_parameters least", "least", ones, "0u") | indent(2) -}}
  {{ record("static const " ~ name ~ "_parameters most", "most", counts, "0u") | indent(2) -}}
  int32_t found = -1;
  int32_t k;
  for (k = ROWS - 1; k >= 0; k--) {
    if ((p->samples[k] < least.samples[k]) || (p->samples[k] > most.samples[k])) {
      found = {{ parameters | sum(attribute="size") }} + k;
    }
  }
{% set at = namespace(end=parameters | sum(attribute="size")) %}
{% for p in parameters | reverse %}
{% set at.end = at.end - p.size %}
  k = first_outside(p->{{ p.name }}, least.{{ p.name }}, most.{{ p.name }}, {{ p.size }}, {{ at.end }});
  found = (k >= 0) ? k : found;
{% endfor %}
  return found;
}

int32_t {{ name }}_refuses_parameters(const {{ name }}_parameters *p, int32_t *entry) {
  int32_t reason = {{ NAME }}_PARAMETERS_NONE;
  *entry = -1;
  if (p != NULL) {
    *entry = out_of_range(p);
    if (*entry >= 0) {
      reason = {{ NAME }}_PARAMETERS_RANGE;
{% if factors %}
    } else if (!have_factors(p)) {
      reason = {{ NAME }}_PARAMETERS_FACTOR;
{% endif %}
    } else if (p->checksum != {{ name }}_checksum(p)) {
      reason = {{ NAME }}_PARAMETERS_CHECKSUM;
    } else {
      reason = {{ NAME }}_PARAMETERS_TAKEN;
    }
  }
  return reason;
}

int32_t {{ name }}_accepts_parameters(const {{ name }}_parameters *p) {
  int32_t entry;
  return ({{ name }}_refuses_parameters(p, &entry) == {{ NAME }}_PARAMETERS_TAKEN) ? 1 : 0;
}

int32_t {{ name }}_set_parameters({{ name }}_state *s, const {{ name }}_parameters *p) {
  const int32_t accepted = {{ name }}_accepts_parameters(p);
  if (accepted == 1) {
    s->parameters = p;
  }
  return accepted;
}

/* Entry by entry: a compiler may call memcpy for a record. */
static void copy_parameters(const {{ name }}_parameters *from, {{ name }}_parameters *to) {
  int32_t k;
{% for p in parameters %}
  for (k = 0; k < {{ p.size }}; k++) {
    to->{{ p.name }}[k] = from->{{ p.name }}[k];
  }
{% endfor %}
  for (k = 0; k < ROWS; k++) {
    to->samples[k] = from->samples[k];
  }
  to->checksum = from->checksum;
}

void {{ name }}_calibration_init({{ name }}_calibration *c) {
  copy_parameters(&{{ name }}_default_parameters, &c->working);
  copy_parameters(&{{ name }}_default_parameters, &c->pages[0]);
  copy_parameters(&{{ name }}_default_parameters, &c->pages[1]);
  c->ready = 0;
  c->used = 0;
  c->reason = {{ NAME }}_PARAMETERS_TAKEN;
  c->entry = -1;
  c->commits = 0;
}

int32_t {{ name }}_calibration_commit({{ name }}_calibration *c, const {{ name }}_parameters *p) {
  if (c->ready != 0) {
    c->reason = {{ NAME }}_PARAMETERS_BUSY;
    c->entry = -1;
  } else {
    const {{ name }}_parameters *const from = (p == NULL) ? &{{ name }}_default_parameters : p;
    {{ name }}_parameters *const page = &c->pages[1 - c->used];
    copy_parameters(from, page);
    page->checksum = {{ name }}_checksum(page);
    c->reason = {{ name }}_refuses_parameters(page, &c->entry);
    if (c->reason == {{ NAME }}_PARAMETERS_TAKEN) {
      c->ready = 1;
    }
  }
  return c->reason;
}

void {{ name }}_calibration_take({{ name }}_calibration *c, {{ name }}_state *s) {
  if (c->ready == 1) {
    c->used = 1 - c->used;
    s->parameters = &c->pages[c->used];
    c->commits++;
    c->ready = 0;
  }
}
