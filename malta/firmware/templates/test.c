/* {{ title }}: recorded vectors. Prints `pass` or the first sample that differs; the exit code is 0 or 1.
   Link with {{ name }}.c, {{ name }}_parts.c and {{ name }}_supervisor.c. Written by malta {{ version }}. */
#include "{{ name }}.h"
#include "{{ name }}_supervisor.h"

#include <math.h> /* of NAN and INFINITY alone */
#include <stdbool.h>
#include <stdio.h>
#include <string.h>
{% include "exact.c" %}

{% include "stand_in.c" %}

#define VECTORS {{ vectors|length }}
#define SAMPLES {{ samples }}
#define READINGS {{ readings }}
#define ANSWERS {{ answers }}

/* p, dp, ddp, then what is read, as in {{ name }}.h; the forces v, then {{ last }}; checksums of all outputs and the state. */
typedef struct {
  const char *name;
  int32_t warm;
  {{ name }}_real readings[SAMPLES][READINGS];
  {{ name }}_real answers[SAMPLES][ANSWERS];
  uint32_t checksums[SAMPLES];
} vector;

{% include "checksum.c" %}

/* Compare one sample; 0 where all bits agree. */
static int32_t compare(const vector *v, int32_t k, const {{ name }}_state *s, const {{ name }}_outputs *out) {
  uint32_t sum = {{ fnv_start }}u;
  int32_t differs = 0;
  int32_t j;
{% for f in output_all %}
  sum = add_all(sum, out->{{ f.name }}, {{ f.size }});
{% endfor %}
{% for f in state_all %}
  sum = add_all(sum, s->{{ f.name }}, {{ f.size }});
{% endfor %}
  if (sum != v->checksums[k]) {
    differs = 1;
    (void)printf("%s: sample %ld differs\n", v->name, (long)k);
  }
  for (j = 0; (differs == 1) && (j < ANSWERS); j++) {
    const int32_t entry = (j < {{ forces }}) ? j : (j - {{ forces }});
    const {{ name }}_real found = (j < {{ forces }}) ? out->v[j] : out->{{ last_field }}[entry];
    if (!(found == v->answers[k][j])) {
      (void)printf("  %s[%ld] is %.17g, expected %.17g\n", (j < {{ forces }}) ? "v" : "{{ last_field }}", (long)entry,
                   (double)found, (double)v->answers[k][j]);
    }
  }
  return differs;
}

static int32_t run(const vector *v, uint32_t *total) {
  {{ name }}_state s;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  int32_t failed = 0;
  int32_t k;
  {{ name }}_init(&s);
  for (k = 0; (failed == 0) && (k < SAMPLES); k++) {
    int32_t next = 0;
    {{ name }}_reference r;
{% for f in reference_all %}
    take(r.{{ f.name }}, v->readings[k], &next, {{ f.size }});
{% endfor %}
{% for f in input_all %}
    take(in.{{ f.name }}, v->readings[k], &next, {{ f.size }});
{% endfor %}
    if ({{ name }}_set_reference(&s, &r) == 0) {
      (void)printf("%s: sample %ld: the reference is refused\n", v->name, (long)k);
      failed = 1;
    } else {
      if ((k == 0) && (v->warm == 1)) {
        {{ name }}_start(&s);
      }
      {{ name }}_step(&s, &in, &out);
      failed = compare(v, k, &s, &out);
      *total = (*total ^ v->checksums[k]) * {{ fnv_factor }}u;
    }
  }
  return failed;
}

{% include "trials.c" %}

{% include "calls.c" %}

int main(void) {
  static const vector vectors[VECTORS] = {
{% for v in vectors %}
  { "{{ v.name }}", {{ v.warm }}, {
{{ v.readings }}
  }, {
{{ v.answers }}
  }, {
{{ v.checksums }}
  } },
{% endfor %}
  };
  uint32_t total = {{ fnv_start }}u;
  int32_t failed = 0;
  int32_t k;
  for (k = 0; k < VECTORS; k++) {
    failed += run(&vectors[k], &total);
  }
  failed += try_tables();
{% if stroke %}
  failed += try_strokes(&total);
{% endif %}
  failed += try_pieces(&total);
  failed += try_supervisor(&total);
  if ({{ name }}_self_test() == 0) {
    failed++;
    (void)printf("the arithmetic of {{ name }}.c or {{ name }}_parts.c is not that of their text: look at the compiler's options\n");
  }
  if (failed == 0) {
    (void)printf("pass: %ld vectors of %ld samples, checksum %08lx\n", (long)VECTORS, (long)SAMPLES,
                 (unsigned long)total);
  }
  return (failed == 0) ? 0 : 1;
}
