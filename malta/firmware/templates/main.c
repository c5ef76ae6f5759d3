/* {{ title }}: a main program for a board, with what {{ name }}_port.h asks of it. Written by malta {{ version }}.

   Define {{ NAME }}_STAND_IN to try all but timer, converters and PWM: a stand-in takes the machine's place. */
#include "{{ name }}_port.h"
#include "{{ name }}_xcp.h"

#include <stdbool.h>
{% include "exact.c" %}

{% include "xcp_bench.c" %}

int32_t {{ name }}_port_check(const {{ name }}_board *board) {
  const {{ name }}_real off = board->period - {{ NAME }}_SAMPLE_TIME;
  const {{ name }}_real most = {{ timer_error }} * {{ NAME }}_SAMPLE_TIME;
  int32_t reason = {{ NAME }}_PORT_FITS;
  if (!((off <= most) && (off >= -most))) {
    reason = {{ NAME }}_PORT_TIMER;
{% if driven %}
  } else if (!(board->current >= {{ largest_current }})) {
    reason = {{ NAME }}_PORT_CURRENTS;
  } else if (!(board->steps >= {{ pwm_steps }})) {
    reason = {{ NAME }}_PORT_PWM;
{% endif %}
  } else if (!((board->delay >= {{ zero }}) && (board->delay <= {{ most_delay }}))) {
    reason = {{ NAME }}_PORT_DELAY;
  } else {
    /* it fits */
  }
  return reason;
}

void {{ name }}_on_sample(int32_t missed) {
#if defined({{ NAME }}_STAND_IN)
  read_bench();
#else
  (void)read_bench;
  {{ name }}_port_read(&in, &request);
#endif
  request.missed = missed;
  {{ name }}_supervisor_step(&supervisor, &state, &in, &request, &out);
  {{ name }}_xcp_event(&xcp);
  {{ name }}_port_write(&out, supervisor.enable);
}

int main(void) {
  static uint8_t frame[{{ NAME }}_XCP_FRAME];
  static {{ name }}_board board;
  bool runs = true;
  {{ name }}_init(&state);
  {{ name }}_supervisor_init(&supervisor);
{% if wiring %}
#if defined({{ NAME }}_STAND_IN)
  supervisor.wired = 1; /* the stand-in has none */
#endif
{% endif %}
  {{ name }}_xcp_init(&xcp, &calibration, &state, &in, &out, &supervisor);
  {{ name }}_port_begin(&board);
  if ({{ name }}_port_check(&board) != {{ NAME }}_PORT_FITS) {
    supervisor.fit = 0; /* the machine stays off, and a tool can ask why a start is refused */
  }
  {{ name }}_port_start();
  while (runs) {
    const int32_t byte = {{ name }}_port_get();
    int32_t bytes = 0;
    int32_t k;
    if (byte >= 0) {
      bytes = {{ name }}_xcp_serial(&xcp, byte, frame);
    } else if (byte == -2) {
      bytes = {{ name }}_xcp_serial(&xcp, -1, frame);
    } else {
      bytes = {{ name }}_xcp_transmit(&xcp, 1, frame);
    }
    for (k = 0; k < bytes; k++) {
      {{ name }}_port_put(frame[k]);
    }
  }
  return 0;
}
