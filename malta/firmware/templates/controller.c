/* {{ title }}: see {{ name }}.h. Written by malta {{ version }}; one operation a statement. */
#include "{{ name }}.h"

#include <stdbool.h>
{% include "exact.c" %}
{% if fma %}

{% include "fused.c" %}
{% endif %}

{% include "arithmetic.c" %}

{# The place of force j in row k of a table of v0(z). #}
{% macro entry(k) %}{{ k if forces == 1 else "(%s * %d)"|format(k, forces) }} + j{% endmacro %}
{% if root %}
{% include "root.c" %}

{% endif %}
{% if loops %}
{% include "apart.c" %}

{% endif %}
{{ sense }}
{{ decide }}
{{ state_at }}
/* v0(z), linear between the points of the table and constant beyond them. */
static void look_up(const {{ name }}_state *s, {{ name }}_real z, {{ name }}_real v0[{{ forces }}]) {
  int32_t low = 0;
  int32_t high = s->points - 1;
  const {{ name }}_real first = s->z[0];
  const {{ name }}_real last = s->z[high];
  const {{ name }}_real bounded = (z < last) ? z : last;
  const {{ name }}_real at = (bounded > first) ? bounded : first;
  while ((high - low) > 1) {
    const int32_t middle = low + ((high - low) / 2);
    if (at < s->z[middle]) {
      high = middle;
    } else {
      low = middle;
    }
  }
  {
    const {{ name }}_real along = at - s->z[low];
    const {{ name }}_real whole = s->z[high] - s->z[low];
    const {{ name }}_real share = along / whole;
    const {{ name }}_real rest = {{ one }} - share;
    int32_t j;
    for (j = 0; j < {{ forces }}; j++) {
      const {{ name }}_real before = rest * s->v0[{{ entry("low") }}];
      const {{ name }}_real after = share * s->v0[{{ entry("high") }}];
      v0[j] = before + after;
    }
  }
}

int32_t {{ name }}_self_test(void) {
  return ({{ name }}_is_exact() == 1) ? {{ name }}_parts_self_test() : 0;
}

void {{ name }}_init({{ name }}_state *s) {
  static const {{ name }}_real own_z[{{ points }}] = {
{{ z_rows }}
  };
  static const {{ name }}_real own_v0[{{ points * forces }}] = { /* N, {{ force_names }} */
{{ v0_rows }}
  };
  int32_t k;
{% for f in state %}
  for (k = 0; k < {{ f.size }}; k++) {
    s->{{ f.name }}[k] = {{ zero }};
  }
{% endfor %}
{% for f in reference %}
  for (k = 0; k < {{ f.size }}; k++) {
    s->reference.{{ f.name }}[k] = {{ zero }};
  }
{% endfor %}
{% if link %}
  s->link_last[0] = {{ link }}; /* V, nominal */
{% endif %}
  s->points = {{ points }};
  s->z = own_z;
  s->v0 = own_v0;
{% if tunable %}
  s->parameters = &{{ name }}_default_parameters;
{% endif %}
}

void {{ name }}_start({{ name }}_state *s) {
  {{ name }}_real v0[{{ forces }}];
  look_up(s, {{ start_z }}, v0);
  {{ call_state_at }};
}

void {{ name }}_step({{ name }}_state *s, const {{ name }}_inputs *in, {{ name }}_outputs *out) {
  {{ name }}_real v0[{{ forces }}];
{% if reads %}
  {{ name }}_real table_at[{{ 2 * reads }}];
  {{ name }}_real table[{{ reads * table_values }}];
{% endif %}
  {{ call_sense }};
  look_up(s, {{ step_z }}, v0);
{% if reads %}
  {{ name }}_read_table(table_at, table);
{% endif %}
  {{ call_decide }};
}

int32_t {{ name }}_set_reference({{ name }}_state *s, const {{ name }}_reference *r) {
{% if tunable %}
  const {{ name }}_real *const most = s->parameters->position;
  const {{ name }}_real *const fastest = s->parameters->speed;
  const {{ name }}_real *const steepest = s->parameters->acceleration;
{% else %}
  static const {{ name }}_real most[{{ outputs }}] = { {{ limits.position }} };
  static const {{ name }}_real fastest[{{ outputs }}] = { {{ limits.speed }} };
  static const {{ name }}_real steepest[{{ outputs }}] = { {{ limits.acceleration }} };
{% endif %}
  bool accepted = true;
  int32_t k;
  for (k = 0; k < {{ outputs }}; k++) {
    const bool near = (r->p[k] <= most[k]) && (r->p[k] >= -most[k]);
    const bool slow = (r->dp[k] <= fastest[k]) && (r->dp[k] >= -fastest[k]);
    const bool even = (r->ddp[k] <= steepest[k]) && (r->ddp[k] >= -steepest[k]);
    accepted = accepted && near && slow && even; /* a NaN is in no interval */
  }
  for (k = 0; accepted && (k < {{ outputs }}); k++) {
    s->reference.p[k] = r->p[k];
    s->reference.dp[k] = r->dp[k];
    s->reference.ddp[k] = r->ddp[k];
  }
  return accepted ? 1 : 0;
}

int32_t {{ name }}_set_v0_table({{ name }}_state *s, int32_t points, const {{ name }}_real z[], const {{ name }}_real v0[]) {
{% if tunable and has_force_limit %}
  const {{ name }}_real *const most = s->parameters->force_limit; /* N */
{% else %}
  static const {{ name }}_real most[{{ forces }}] = { {{ force_limits }} }; /* N */
{% endif %}
  bool accepted = (points >= 2) && (points <= {{ most_points }});
  int32_t k;
  for (k = 0; accepted && (k < points); k++) {
    int32_t j;
    accepted = (z[k] >= -{{ most_rate }}) && (z[k] <= {{ most_rate }});
    if (accepted && (k > 0)) {
      accepted = z[k] > z[k - 1];
    }
    for (j = 0; j < {{ forces }}; j++) {
      const {{ name }}_real force = v0[{{ entry("k") }}];
      accepted = accepted && (force <= most[j]) && (force >= -most[j]);
    }
  }
  if (accepted) {
    s->points = points;
    s->z = z;
    s->v0 = v0;
  }
  return accepted ? 1 : 0;
}

void {{ name }}_reset_integrators({{ name }}_state *s) {
  int32_t k;
{% for f in sums %}
  for (k = {{ f.first }}; k < {{ f.end }}; k++) {
    s->{{ f.name }}[k] = {{ zero }};
  }
{% endfor %}
}
{% if stroke %}

int32_t {{ name }}_start_stroke({{ name }}_stroke *k, int32_t profile, {{ name }}_real start, {{ name }}_real end,
                       {{ name }}_real rise) {
  static const {{ name }}_real reach[{{ outputs }}] = { {{ limits.position }} };
  const {{ name }}_real most = reach[{{ stroke_output }}];
  const {{ name }}_real limit = {{ longest_rise }};
  const bool known = (profile == {{ NAME }}_LOGISTIC) || (profile == {{ NAME }}_QUINTIC);
  const bool near = (start <= most) && (start >= -most) && (end <= most) && (end >= -most);
  const bool slow = (rise >= {{ NAME }}_SAMPLE_TIME) && (rise <= limit);
  const bool accepted = known && near && slow;
  if (accepted) {
    const {{ name }}_real lasts = {{ rises }} * rise;
    const {{ name }}_real periods = lasts / {{ NAME }}_SAMPLE_TIME;
    k->profile = profile;
    k->start = start;
    k->end = end;
    k->rise = rise;
    k->sample = 0;
    k->samples = (int32_t)periods + 1;
  }
  return accepted ? 1 : 0;
}

int32_t {{ name }}_follow_stroke({{ name }}_stroke *k, {{ name }}_reference *r) {
  const int32_t halves = (2 * k->sample) - k->samples; /* since the middle */
  const {{ name }}_real count = ({{ name }}_real)halves;
  const {{ name }}_real half = {{ half }} * {{ NAME }}_SAMPLE_TIME;
  {{ name }}_real t[1];
  {{ name }}_real share[1];
  {{ name }}_real rate[1];
  {{ name }}_real acceleration[1];
  const {{ name }}_real way = k->end - k->start;
  int32_t j;
  t[0] = count * half;
  if (k->profile == {{ NAME }}_QUINTIC) {
    {{ name }}_quintic(t, &k->rise, share, rate, acceleration);
  } else {
    {{ name }}_logistic(t, &k->rise, share, rate, acceleration);
  }
  for (j = 0; j < {{ outputs }}; j++) {
    r->p[j] = {{ zero }};
    r->dp[j] = {{ zero }};
    r->ddp[j] = {{ zero }};
  }
  {
    const {{ name }}_real gone = way * share[0];
    r->p[{{ stroke_output }}] = k->start + gone;
    r->dp[{{ stroke_output }}] = way * rate[0];
    r->ddp[{{ stroke_output }}] = way * acceleration[0];
  }
  if (k->sample < k->samples) {
    k->sample++;
  }
  return (k->sample < k->samples) ? 1 : 0;
}
{% endif %}
