{% if model is defined %}
/* In place of hardware: a machine that moves as the law's model does. */
{% else %}
/* In place of hardware: a machine that is where its reference is, and whose currents are those that are commanded. */
{% endif %}
typedef struct {
  uint32_t seed; /* of the noise of its sensors */
  int32_t back;
  {{ name }}_real drawn[{{ outputs }}];
  {{ name }}_real rest[{{ outputs }}];
{% if model is defined %}
  int32_t still; /* 1: it stays where its reference is, whatever a fault makes of the law */
  int32_t flew;
  {{ name }}_real x[{{ order }}];
{% endif %}
} stand_in;

{% if driven %}
{% if stand_in_root %}
{% include "root.c" %}

{% endif %}
{{ phases }}
{% endif %}
/* From -1 to 1, the same on every processor. */
static {{ name }}_real noise_of(stand_in *m) {
  int32_t whole;
  m->seed = (m->seed * 1664525u) + 1013904223u;
  whole = (int32_t)(uint32_t)(m->seed >> 16) - 32768;
  return ({{ name }}_real)whole * {{ noise_step }};
}

{% if model is defined %}
{% if reached is defined %}
static const {{ name }}_real shown[{{ outputs }} * {{ order }}] = { {{ shown }} }; /* readings by states */

{% endif %}
/* The next state: the filter's prediction, which knows the command, and what the model makes of the estimate's error. */
static void move_stand_in(stand_in *m, int32_t flies, const {{ name }}_state *s, const {{ name }}_outputs *last) {
  static const {{ name }}_real model[{{ order }} * {{ order }}] = { {{ model }} };
  {{ name }}_real after[{{ order }}];
  int32_t i;
  int32_t j;
  for (i = 0; i < {{ order }}; i++) {
    after[i] = s->xi_pred[i];
    for (j = 0; (m->flew == 1) && (j < {{ order }}); j++) {
      after[i] = after[i] + (model[(i * {{ order }}) + j] * (m->x[j] - last->xi_hat[j]));
    }
  }
  for (i = 0; i < {{ order }}; i++) {
    m->x[i] = after[i];
  }
  m->flew = flies;
}

{% endif %}
/* Readings of a sample; flies: whether the machine follows its reference, or rests. */
static void read_stand_in(stand_in *m, int32_t flies, const {{ name }}_state *s,{{ " const %s_outputs *last,"|format(name) if driven or model is defined }} {{ name }}_inputs *in) {
  static const {{ name }}_real noise[{{ outputs }}] = { {{ noise }} };
{% if reached is defined %}
  static const {{ name }}_real reached[{{ outputs }} * {{ outputs }}] = { {{ reached }} }; /* by references, at rest */
{% endif %}
  {{ name }}_real place[{{ outputs }}];
  int32_t k;
{% if model is defined %}
  move_stand_in(m, flies, s, last);
{% endif %}
  for (k = 0; k < {{ outputs }}; k++) {
    m->drawn[k] = (m->back == 1) ? -m->drawn[k] : (noise_of(m) * noise[k]); /* in pairs: no sum of errors drifts */
{% if reached is defined %}
    place[k] = m->rest[k];
    if (flies == 1) {
      int32_t j;
      place[k] = {{ zero }};
      for (j = 0; j < {{ outputs }}; j++) {
        place[k] = place[k] + (reached[(k * {{ outputs }}) + j] * s->reference.p[j]);
      }
    }
{% else %}
    place[k] = (flies == 1) ? s->reference.p[k] : m->rest[k];
{% endif %}
{% if model is defined and reached is defined %}
    if ((flies == 1) && (m->still == 0)) {
      int32_t j;
      place[k] = {{ zero }};
      for (j = 0; j < {{ order }}; j++) {
        place[k] = place[k] + (shown[{{ "j" if outputs == 1 else "(k * %d) + j"|format(order) }}] * m->x[j]);
      }
    }
{% endif %}
    in->y[k] = place[k] + m->drawn[k];
    in->y_valid[k] = {{ one }};
  }
  m->back = 1 - m->back;
{% if driven %}
  {{ name }}_phases(place, last->current, in->i);
  for (k = 0; k < {{ currents }}; k++) {
    const {{ name }}_real more = noise_of(m) * {{ current_noise }};
    in->i[k] = in->i[k] + more;
    in->i_valid[k] = {{ one }};
  }
  in->link[0] = {{ link }};
{% endif %}
}
