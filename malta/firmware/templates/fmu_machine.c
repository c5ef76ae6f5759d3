/* The machine between two samples: see {{ name }}.h. Written by malta {{ version }}; one operation a statement. */
#include "{{ name }}.h"

#include <stdbool.h>
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
static void look_up({{ name }}_real z, {{ name }}_real v0[{{ forces }}]) {
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

void {{ name }}_start({{ name }}_state *s, const {{ name }}_real x[{{ states }}]{% if volts %}, {{ name }}_real u_integral[{{ volts }}]{% endif %}) {
  {{ name }}_real v0[{{ forces }}];
  look_up({{ at }}, v0);
  {{ call_begin }};
  s->samples = 0.0;
  s->substeps = 0.0;
}

void {{ name }}_step({{ name }}_state *s, const {{ name }}_real command[{{ held }}]{% if wrench %}, const {{ name }}_real w[{{ wrench }}]{% endif %}{% if delay %}, int32_t late{% endif %}) {
  {{ name }}_real until;
  {{ name }}_real acting[{{ held }}];
  int32_t k;
  for (k = 0; k < {{ held }}; k++) {
    acting[k] = {% if delay %}(late != 0) ? s->under_way[k] : {% endif %}command[k];
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
    s->substeps = s->substeps + 1.0;
  }
}

void {{ name }}_look(const {{ name }}_state *s, {{ name }}_readings *r) {
  {{ call_read }};
}
