/* {{ title }}: a main program with a loop on a timer. Put your hardware's functions in place of the first five; as they
   are here, they run on a PC. Written by malta {{ version }}. */
#include "{{ name }}.h"
{% include "exact.c" %}

/* Wait for the timer of {{ period }}; 0 ends the program. */
static int32_t wait_for_timer(void) {
  static int32_t samples_left = {{ example_samples }};
  samples_left--;
  return (samples_left >= 0) ? 1 : 0;
}

/* Raw readings of the position sensors, and 1 where a sensor calls its reading valid. */
static void read_positions({{ name }}_real raw[{{ outputs }}], {{ name }}_real valid[{{ outputs }}]) {
  int32_t k;
  for (k = 0; k < {{ outputs }}; k++) {
    raw[k] = {{ zero }};
    valid[k] = {{ one }};
  }
}
{% if driven %}

/* Phase currents, A, and the voltage of the DC link, V. */
static void read_currents({{ name }}_inputs *in) {
  int32_t k;
  for (k = 0; k < {{ currents }}; k++) {
    in->i[k] = {{ zero }};
    in->i_valid[k] = {{ one }};
  }
  in->link[0] = {{ link }};
}
{% endif %}

/* What the sensors' data sheets and calibration say: y = gain raw + offset, m. */
static void read_calibration({{ name }}_real gain[{{ outputs }}], {{ name }}_real offset[{{ outputs }}]) {
  int32_t k;
  for (k = 0; k < {{ outputs }}; k++) {
    gain[k] = {{ one }};
    offset[k] = {{ zero }};
  }
}

/* {{ last_output }}. */
static void write_outputs(const {{ name }}_outputs *out) { (void)out; }

int main(void) {
  {{ name }}_state state;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  {{ name }}_real raw[{{ outputs }}];
  {{ name }}_real gain[{{ outputs }}];
  {{ name }}_real offset[{{ outputs }}];
{% if stroke %}
  {{ name }}_stroke stroke;
  {{ name }}_reference reference;
{% endif %}
  {{ name }}_init(&state);
  read_calibration(gain, offset);
{% if stroke %}
  (void){{ name }}_start_stroke(&stroke, {{ NAME }}_QUINTIC, {{ zero }}, {{ example_end }}, {{ example_rise }});
{% endif %}
  while (wait_for_timer() == 1) {
    read_positions(raw, in.y_valid);
    {{ name }}_calibrate(raw, gain, offset, in.y);
{% if driven %}
    read_currents(&in);
{% endif %}
{% if stroke %}
    (void){{ name }}_follow_stroke(&stroke, &reference);
    (void){{ name }}_set_reference(&state, &reference);
{% endif %}
    {{ name }}_step(&state, &in, &out);
    write_outputs(&out);
  }
  return 0;
}
