{% include "stand_in.c" %}

static {{ name }}_supervisor supervisor;
static {{ name }}_state state;
static {{ name }}_request request;
static {{ name }}_inputs in;
static {{ name }}_outputs out;
static {{ name }}_calibration calibration;
static {{ name }}_xcp xcp;
static stand_in machine;

/* What is read and asked for with a stand-in in place of the machine: it starts after ten samples. */
static void read_bench(void) {
  static int32_t samples = 0;
  samples = (samples < 20) ? (samples + 1) : samples;
  request.start = ((samples >= 10) && (samples < 20)) ? 1 : 0;
  request.operate = 1;
{% if driven or model is defined %}
  read_stand_in(&machine, supervisor.enable, &state, &out, &in);
{% else %}
  read_stand_in(&machine, supervisor.enable, &state, &in);
{% endif %}
}
