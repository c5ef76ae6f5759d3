/* The machine between two samples: see {{ name }}.h. Written by malta {{ version }}; one operation a statement. */
#include "{{ name }}.h"

#include <stdbool.h>
{% if noises %}
#include <string.h>
{% endif %}
{% include "exact.c" %}

static const {{ name }}_real own_z[{{ points }}] = {
{{ z_rows }}
};
static const {{ name }}_real own_v0[{{ points * forces }}] = {
{{ v0_rows }}
};

{% if root %}
{% include "root.c" %}

{% endif %}
{{ functions }}
/* v0(z), linear between the points of the table and constant beyond them. */
static void look_up_own({{ name }}_real z, {{ name }}_real v0[{{ forces }}]) {
  const {{ name }}_real bounded = (z < own_z[{{ points - 1 }}]) ? z : own_z[{{ points - 1 }}];
  const {{ name }}_real at = (bounded > own_z[0]) ? bounded : own_z[0];
  {{ name }}_real share;
  int32_t k = 0;
  int32_t j;
  while ((k < {{ points - 2 }}) && (at >= own_z[k + 1])) {
    k++;
  }
  share = (at - own_z[k]) / (own_z[k + 1] - own_z[k]);
  for (j = 0; j < {{ forces }}; j++) {
    v0[j] = ((1.0 - share) * own_v0[(k * {{ forces }}) + j]) + (share * own_v0[((k + 1) * {{ forces }}) + j]);
  }
}

/* Open switches carry no current; the diodes have ended it within a substep. */
static void end_currents({{ name }}_state *s) {
  int32_t k;
  for (k = 0; k < {{ flowing.size }}; k++) {
    s->state[{{ flowing.at }} + k] = 0.0;
  }
}

void {{ name }}_start({{ name }}_state *s, const {{ name }}_real par[{{ parameters }}], const {{ name }}_real x[{{ states }}], {{ name }}_real cold{% if volts %}, {{ name }}_real u_integral[{{ volts }}]{% endif %}) {
  {{ name }}_real v0[{{ forces }}];
  look_up_own({{ at }}, v0);
  {{ call_begin }};
  s->samples = 0.0;
  s->substeps = 0.0;
}

void {{ name }}_step({{ name }}_state *s, const {{ name }}_real par[{{ parameters }}], const {{ name }}_real command[{{ held }}], int32_t gates{% if wrench %}, const {{ name }}_real w[{{ wrench }}]{% endif %}{% if delay %}, int32_t late{% endif %}) {
  static const {{ name }}_real off[{{ held }}] = { {{ off }} };
  {{ name }}_real until;
  {{ name }}_real acting[{{ acting }}];
  int32_t k;
  for (k = 0; k < {{ held }}; k++) {
    acting[k] = {% if delay %}(late != 0) ? s->under_way[k] : {% endif %}command[k];
  }
{% if acting > held %}
  for (k = 0; k < {{ held }}; k++) { /* from a fraction of the sample on */
    acting[{{ held }} + k] = {% if delay > 1 %}(late != 0) ? s->under_way[{{ held }} + k] : {% endif %}command[k];
  }
{% endif %}
  if (gates == 0) {
    end_currents(s);
    for (k = 0; k < {{ held }}; k++) {
      acting[k] = off[k];
{% if acting > held %}
      acting[{{ held }} + k] = off[k];
{% endif %}
    }
  }
{% if delay %}
  for (k = 0; k < {{ (delay - 1) * held }}; k++) {
    s->under_way[k] = s->under_way[k + {{ held }}];
  }
  for (k = 0; k < {{ held }}; k++) {
    s->under_way[{{ (delay - 1) * held }} + k] = command[k];
  }
{% endif %}
  s->samples = s->samples + 1.0;
  until = (s->samples * {{ substeps }}) - {{ tiny }};
  while (s->substeps < until) {
    {{ call_substep }};
    if (gates == 0) {
      end_currents(s);
    }
    s->substeps = s->substeps + 1.0;
  }
}

{% if noises %}
static uint64_t split_mix(uint64_t key, uint64_t count) {
  uint64_t x = key + (count * 0x9e3779b97f4a7c15u);
  x = (x ^ (x >> 30)) * 0xbf58476d1ce4e5b9u;
  x = (x ^ (x >> 27)) * 0x94d049bb133111ebu;
  return x ^ (x >> 31);
}

static float polynomial(float x, const float *coefficients, int32_t degree) {
  float value = coefficients[degree];
  int32_t k;
  for (k = degree - 1; k >= 0; k--) {
    const float product = x * value;
    value = coefficients[k] + product;
  }
  return value;
}

/* A normal number of a stream, of which each counter gives two: see malta/simulation/readings.py, whose bits these are. */
static {{ name }}_real normal_number(uint64_t key, uint64_t number) {
  static const float logarithm[8] = { {{ logarithm }} };
  static const float cosine[5] = { {{ cosine }} };
  static const float sine[5] = { {{ sine }} };
  const uint64_t bits = split_mix(key, number / 2u);
  const uint32_t high = (uint32_t)(bits >> 32) | 1u;
  const uint32_t low = (uint32_t)bits;
  const float whole = (float)high;
  const uint32_t turned = (low << 1) ^ 0x80000000u;
  const float half_turns = (float)((turned < 0x80000000u) ? (int64_t)turned : ((int64_t)turned - 4294967296)) * 0x1p-32f;
  const float square = half_turns * half_turns;
  uint32_t pattern;
  float share;
  float radius;
  int32_t k = 0;
  memcpy(&pattern, &whole, sizeof pattern);
  while (pattern >= 0x3fb504f3u) { /* share of 2^k, from sqrt(1/2) to sqrt(2) */
    pattern = pattern - 0x00800000u;
    k++;
  }
  memcpy(&share, &pattern, sizeof share);
  share = share - 1.0f;
  radius = share * polynomial(share, logarithm, 7);
  radius = radius + (0.69314718f * (float)(k - 32));
  radius = (float){{ name }}_root((double)(-2.0f * radius));
  radius = ((low & 0x80000000u) != 0u) ? -radius : radius;
  return ({{ name }}_real)(((number % 2u) == 0u) ? (radius * polynomial(square, cosine, 4))
                                                  : (radius * (half_turns * polynomial(square, sine, 4))));
}

{% endif %}
void {{ name }}_look(const {{ name }}_state *s, const {{ name }}_real par[{{ parameters }}]{% if noises %}, {{ name }}_real noise, {{ name }}_real seed{% endif %}, {{ name }}_readings *r) {
{% if noises %}
  const uint64_t stream = split_mix(((uint64_t)seed * 0x9e3779b97f4a7c15u) + 1u, 0u);
  const uint64_t key = split_mix(stream + 0xd1342543de82ef95u, 0u);
  const uint64_t first = (uint64_t)s->samples * {{ noises }}u;
  {{ name }}_real normals[{{ noises }}];
  uint64_t k;
  for (k = 0u; k < {{ noises }}u; k++) {
    normals[k] = (noise > 0.0) ? (noise * normal_number(key, first + k)) : 0.0;
  }
{% endif %}
  {{ call_read }};
}
