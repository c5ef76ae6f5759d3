/* {{ title }}: a main program with a loop on a timer, controller and supervisor. Put your hardware's functions in place of
   the first six; as they are here, they run on a PC. Written by malta {{ version }}. */
#include "{{ name }}.h"
#include "{{ name }}_supervisor.h"
{% if logged %}
#include "{{ name }}_log.h"
{% endif %}
{% set inputs, outs = ("now->in", "now->out") if logged else ("in", "out") %}

#include <stdbool.h>
{% include "exact.c" %}

{% include "stand_in.c" %}

/* Wait for the timer of {{ period }}; 0 ends the program. missed: periods of the timer that went by since the last one. */
static int32_t wait_for_timer(int32_t *missed) {
  static int32_t samples_left = {{ example_samples }};
  samples_left--;
  *missed = 0;
  return (samples_left >= 0) ? 1 : 0;
}

/* Raw readings of the position sensors, and 1 where a sensor calls its reading valid{{ "; phase currents, A, and the link, V" if driven }}. */
static void read_sensors(stand_in *m, const {{ name }}_supervisor *sup, const {{ name }}_state *s,
                         const {{ name }}_outputs *last, {{ name }}_real raw[{{ outputs }}], {{ name }}_inputs *in) {
  int32_t k;
{% if driven or model is defined %}
  read_stand_in(m, sup->enable, s, last, in);
{% else %}
  (void)last;
  read_stand_in(m, sup->enable, s, in);
{% endif %}
  for (k = 0; k < {{ outputs }}; k++) {
    raw[k] = in->y[k];
  }
}

/* What the sensors' data sheets and calibration say: y = gain raw + offset, m. */
static void read_calibration({{ name }}_real gain[{{ outputs }}], {{ name }}_real offset[{{ outputs }}]) {
  int32_t k;
  for (k = 0; k < {{ outputs }}; k++) {
    gain[k] = {{ one }};
    offset[k] = {{ zero }};
  }
}

/* Buttons. Start and acknowledge count when they are pressed, not while they are: this one is pressed at the tenth sample. */
static void read_buttons({{ name }}_request *request) {
  static int32_t sample = 0;
  if (sample < 20) {
    sample++;
  }
  request->start = 0;
  if ((sample >= 10) && (sample < 20)) {
    request->start = 1;
  }
  request->acknowledge = 0; /* 1: go on after a fault */
  request->stop = 0;        /* 1: emergency stop */
}

/* 1 while the drive's safe torque off is active. */
static int32_t read_sto(void) { return 0; }

/* {{ last_output }}; enable: gates of the bridges on, or all switches open. */
static void write_outputs(const {{ name }}_outputs *out, int32_t enable) {
  (void)out;
  (void)enable;
}

{% if logged %}
/* The bytes of the ring, to be written into a file NAME.dump. */
static void write_dump(const {{ name }}_log *log) { (void)log; }

{% endif %}
/* What a machine in operation shall do next: 1 while it moves. */
{% if stroke %}
static int32_t follow({{ name }}_stroke *stroke, {{ name }}_request *request) {
  return {{ name }}_follow_stroke(stroke, &request->reference);
}
{% else %}
static int32_t follow(int32_t *samples_left) {
  *samples_left = *samples_left - 1;
  return (*samples_left > 0) ? 1 : 0;
}
{% endif %}

int main(void) {
  static {{ name }}_supervisor supervisor;
  static {{ name }}_state state;
  static {{ name }}_request request; /* zeros: nothing is asked for */
{% if logged %}
  static {{ name }}_log log;
  {{ name }}_sample *now = {{ name }}_log_sample(&log);
{% else %}
  static {{ name }}_inputs in;
  static {{ name }}_outputs out;
{% endif %}
  static stand_in machine;
  {{ name }}_real raw[{{ outputs }}];
  {{ name }}_real gain[{{ outputs }}];
  {{ name }}_real offset[{{ outputs }}];
{% if stroke %}
  {{ name }}_stroke stroke;
  int32_t ready = {{ name }}_start_stroke(&stroke, {{ NAME }}_QUINTIC, {{ zero }}, {{ example_end }}, {{ example_rise }});
{% else %}
  int32_t hover = 100; /* samples */
  int32_t ready = 1;
{% endif %}
  {{ name }}_init(&state);
  {{ name }}_supervisor_init(&supervisor);
{% if wiring %}
  supervisor.wired = 1; /* the stand-in has no wiring: remove this line, and the wiring is tried before the first lift-off */
{% endif %}
{% if logged %}
  {{ name }}_log_init(&log, &state, {{ NAME }}_LOG_ROWS / 2);
{% endif %}
  read_calibration(gain, offset);
  if ({{ name }}_self_test() == 0) {
    ready = 0; /* a compiler's own arithmetic */
  }
  while ((ready == 1) && (wait_for_timer(&request.missed) == 1)) {
{% if logged %}
    const {{ name }}_outputs *const last = &now->out;
{% endif %}
    read_buttons(&request);
    request.sto = read_sto();
    request.operate = 1; /* as soon as it has settled */
    if ((supervisor.state == {{ NAME }}_OPERATE) && (request.land == 0)) {
      request.land = 1 - follow({{ "&stroke, &request" if stroke else "&hover" }});
    }
{% if logged %}
    now = {{ name }}_log_sample(&log);
{% endif %}
    read_sensors(&machine, &supervisor, &state, {{ "last" if logged else "&out" }}, raw, &{{ inputs }});
    {{ name }}_calibrate(raw, gain, offset, {{ inputs }}.y);
    {{ name }}_supervisor_step(&supervisor, &state, &{{ inputs }}, &request, &{{ outs }});
{% if logged %}
    {{ name }}_log_keep(&log, &state, supervisor.enable, (supervisor.monitor == -1) ? 0 : 1);
{% endif %}
    write_outputs(&{{ outs }}, supervisor.enable);
  }
{% if logged %}
  write_dump(&log);
{% endif %}
  /* 0 where it moved and landed, and no monitor acted */
  return ((request.land == 1) && (supervisor.state == {{ NAME }}_OFF) && (supervisor.monitor == -1)) ? 0 : 1;
}
