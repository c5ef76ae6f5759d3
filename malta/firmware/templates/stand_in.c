/* In place of hardware: a machine that is where its reference is, and whose currents are those that are commanded. */
typedef struct {
  uint32_t seed; /* of the noise of its sensors */
  int32_t back;
  {{ name }}_real drawn[{{ outputs }}];
  {{ name }}_real rest[{{ outputs }}];
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

/* Readings of a sample; flies: whether the machine follows its reference, or rests. */
static void read_stand_in(stand_in *m, int32_t flies, const {{ name }}_state *s,{{ " const %s_outputs *last,"|format(name) if driven }} {{ name }}_inputs *in) {
  static const {{ name }}_real noise[{{ outputs }}] = { {{ noise }} };
{% if reached is defined %}
  static const {{ name }}_real reached[{{ outputs }} * {{ outputs }}] = { {{ reached }} }; /* by references, at rest */
{% endif %}
  {{ name }}_real place[{{ outputs }}];
  int32_t k;
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
