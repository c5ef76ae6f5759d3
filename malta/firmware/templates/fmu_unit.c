/* {{ title }}: see unit.h. Written by malta {{ version }}. */
#include "unit.h"

#include <string.h>
{% include "exact.c" %}

/* Each variable: t time, i input, p parameter, q parameter that may change between steps, o output or local. */
static const char roles[] = {% for line in roles %}

    "{{ line }}"{% endfor %};

static const double starts[UNIT_VARIABLES] = {
{{ starts }}
};

{% if limits %}
/* Parameters that have a range. */
static const struct {
  uint32_t reference;
  double least;
  double most;
} limits[{{ limits | length }}] = {
{% for reference, least, most in limits %}
  { {{ reference }}u, {{ least }}, {{ most }} },
{% endfor %}
};

{% endif %}
{% macro copy(target, source, size, kind="") %}
  for (k = 0; k < {{ size }}; k++) {
    {{ target }}[k] = {{ "(" ~ kind ~ ")" if kind else "" }}{{ source }};
  }
{% endmacro %}
#define STEP_ROUNDING 1e-6 /* of a sample */

static int is_finite(double x) {
  const double difference = x - x;
  return (difference == 0.0) ? 1 : 0;
}

static int refuse(const char **message, const char *text) {
  *message = text;
  return UNIT_ERROR;
}
{% if tunable %}

/* The controller's parameters as they are set: each has its range, and the checksum is that of all. */
static void tune(unit_data *u) {
  int32_t k;
  u->parameters = {{ default_record }};
{% for f in tuned %}
{{ copy("u->parameters." ~ f.field, "u->value[" ~ f.at ~ " + k]", f.size, name ~ "_real") }}
{%- endfor %}
  u->parameters.checksum = {{ name }}_checksum(&u->parameters);
  (void){{ name }}_set_parameters(&u->controller, &u->parameters);
}
{% endif %}
{% if controller %}

{% if supervised %}
/* Requests are 1 from a half on; a number that is none is no request. */
static int32_t whole_of(double x) {
  return (x >= 0.5) ? (int32_t)(((x < 1e9) ? x : 1e9) + 0.5) : 0;
}

static void control(unit_data *u, {{ name }}_supervisor *sup, {{ name }}_state *s) {
  {{ name }}_request request;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  int32_t k;
{% for key in requests %}
  request.{{ key }} = whole_of(u->value[{{ at.request + loop.index0 }}]);
{% endfor %}
{% for f in reference %}
{{ copy("request.reference." ~ f.field, "u->value[" ~ f.at ~ " + k]", f.size, name ~ "_real") }}
{%- endfor %}
{% else %}
/* A reference that is out of reach changes nothing: the last one stays. */
static int refer(unit_data *u, const char **message) {
  {{ name }}_reference r;
  int32_t k;
{% for f in reference %}
{{ copy("r." ~ f.field, "u->value[" ~ f.at ~ " + k]", f.size, name ~ "_real") }}
{%- endfor %}
  if ({{ name }}_set_reference(&u->controller, &r) == 0) {
    *message = "a reference that is out of reach or no number is not used: the last one stays";
    return UNIT_WARNING;
  }
  return UNIT_OK;
}

static void control(unit_data *u, {{ name }}_state *s) {
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  int32_t k;
{% endif %}
{% for f in inputs %}
{{ copy("in." ~ f.field, "u->value[" ~ f.at ~ " + k]" if f.at else one, f.size, name ~ "_real") }}
{%- endfor %}
{% if supervised %}
  {{ name }}_supervisor_step(sup, s, &in, &request, &out);
{% for key in supervision %}
  u->value[{{ at.supervisor + loop.index0 }}] = (double)sup->{{ key }};
{% endfor %}
{% else %}
  {{ name }}_step(s, &in, &out);
{% endif %}
{% for f in outputs %}
{{ copy("(u->value + " ~ f.at ~ ")", "out." ~ f.field ~ "[k]", f.size, "double") }}
{%- endfor %}
}
{% endif %}
{% if machine %}

static void look(unit_data *u) {
  {{ plant }}_readings r;
  int32_t k;
  {{ plant }}_look(&u->machine, u->value + {{ at.machine | default(0) }}{% if noises %}, u->value[{{ at.noise }}], u->value[{{ at.seed }}]{% endif %}, &r);
{% for f in readings %}
{{ copy("(u->value + " ~ f.at ~ ")", "r." ~ f.field ~ "[k]", f.size) }}
{%- endfor %}
}
{% endif %}

void unit_reset(unit_data *u) {
  memset(u, 0, sizeof *u);
  memcpy(u->value, starts, sizeof starts);
{% if controller %}
  {{ name }}_init(&u->controller);
{% endif %}
  u->phase = UNIT_NEW;
}

/* The state and the outputs at the start, from parameters and inputs. The outputs of a controller are those of its first
   sample, which the first step computes again. */
static int start(unit_data *u, const char **message) {
  int status = UNIT_OK;
{% if machine %}
{% if volts %}
  double u_integral[{{ volts }}];
{% endif %}
{% if controller %}
  double x[{{ states }}];
  {{ plant }}_place(u->value + {{ at.p_ref }}, u->value + {{ at.dp_ref }}, u->value + {{ at.offset }}, x);
  {{ plant }}_start(&u->machine, u->value + {{ at.machine | default(0) }}, x, 0.0{% if volts %}, u_integral{% endif %});
{% else %}
  {{ plant }}_start(&u->machine, u->value + {{ at.machine | default(0) }}, u->value + {{ at.x_start }}, u->value[{{ at.cold }}]{% if volts %}, u_integral{% endif %});
{% endif %}
  look(u);
{% endif %}
{% if supervised %}
  {{ name }}_state trial;
  {{ name }}_supervisor watching;
  {{ name }}_init(&u->controller);
{% if tunable %}
  tune(u);
{% endif %}
  {{ name }}_supervisor_init(&u->supervisor);
  if (u->value[{{ at.flying }}] > 0.5) {
    {{ name }}_real rest[{{ rests }}];
    {{ name }}_reference r;
    int32_t k;
{% for f in reference %}
{{ copy("r." ~ f.field, "u->value[" ~ f.at ~ " + k]", f.size, name ~ "_real")|indent(2, true) }}
{%- endfor %}
{{ copy("rest", "u->value[" ~ at.rest ~ " + k]", rests, name ~ "_real")|indent(2, true) }}
    if ({{ name }}_set_reference(&u->controller, &r) == 0) {
      return refuse(message, "a flight that begins at a reference which is out of reach");
    }
    {{ name }}_start(&u->controller);
    {{ name }}_supervisor_take_over(&u->supervisor, rest);
  }
  trial = u->controller;
  watching = u->supervisor;
  control(u, &watching, &trial);
{% elif controller %}
  {{ name }}_state trial;
  {{ name }}_init(&u->controller);
{% if tunable %}
  tune(u);
{% endif %}
  status = refer(u, message);
  {{ name }}_start(&u->controller);
{% if machine %}
  {
    double xi[{{ filtered }}];
    int32_t k;
{{ copy("xi", "(double)u->controller.xi_pred[k]", filtered)|indent(2, true) }}
    {{ plant }}_shift(xi, u->value + {{ at.offset }}, xi);
{{ copy("u->controller.xi_pred", "xi[k]", filtered, name ~ "_real")|indent(2, true) }}
{%- if volts %}
{{ copy("u->controller.u_integral", "u_integral[k]", volts, name ~ "_real")|indent(2, true) }}
{{- copy("u->controller.i_last", "u->value[" ~ at.i ~ " + k]", currents, name ~ "_real")|indent(2, true) }}
{%- endif %}
  }
{% endif %}
  trial = u->controller;
  control(u, &trial);
{% else %}
  (void)message;
{% endif %}
  u->changed = 0;
  return status;
}

int unit_begin(unit_data *u, double time, const char **message) {
  if (u->phase != UNIT_NEW) {
    return refuse(message, "an initialization after the start");
  }
  if (is_finite(time) == 0) {
    return refuse(message, "a start time that is no number");
  }
{% if controller %}
  if ({{ name }}_self_test() == 0) {
    return refuse(message, "compiled with another arithmetic than that of its text");
  }
{% endif %}
  u->value[0] = time;
  u->phase = UNIT_INITIAL;
  u->changed = 1;
  return UNIT_OK;
}

int unit_finish_beginning(unit_data *u, const char **message) {
  int status;
  if (u->phase != UNIT_INITIAL) {
    return refuse(message, "the end of an initialization that has not begun");
  }
  status = start(u, message);
  u->phase = UNIT_RUNNING;
  return status;
}

int unit_get(unit_data *u, uint32_t reference, double *value, const char **message) {
  if (reference >= UNIT_VARIABLES) {
    return refuse(message, "a value reference that no variable has");
  }
  if ((u->phase == UNIT_INITIAL) && (u->changed == 1)) {
    const char *later = NULL;
    (void)start(u, &later); /* what is wrong is said at the end of the initialization */
  }
  *value = u->value[reference];
  return UNIT_OK;
}

int unit_set(unit_data *u, uint32_t reference, double value, const char **message) {
  char role;
{% if limits %}
  int32_t k;
{% endif %}
  if (reference >= UNIT_VARIABLES) {
    return refuse(message, "a value reference that no variable has");
  }
  role = roles[reference];
  if ((role == 't') || (role == 'o')) {
    return refuse(message, "only inputs and parameters can be set");
  }
  if (u->phase == UNIT_ENDED) {
    return refuse(message, "a value after the end");
  }
  if ((role == 'p') && (u->phase == UNIT_RUNNING)) {
    return refuse(message, "a parameter is fixed when the initialization has ended");
  }
  if ((role != 'i') && (is_finite(value) == 0)) {
    return refuse(message, "a parameter that is no finite number");
  }
{% if limits %}
  for (k = 0; k < {{ limits | length }}; k++) {
    if ((limits[k].reference == reference) && !((value >= limits[k].least) && (value <= limits[k].most))) {
      return refuse(message, "a parameter out of its range");
    }
  }
{% endif %}
  u->value[reference] = value;
  u->changed = 1;
  return UNIT_OK;
}

/* One sample. */
static int sample(unit_data *u, const char **message) {
  int status = UNIT_OK;
{% if tunable %}
  if (u->changed == 1) {
    tune(u);
    u->changed = 0;
  }
  u->controller.parameters = &u->parameters; /* also where the state came from elsewhere */
{% endif %}
{% if supervised %}
  (void)message;
  control(u, &u->supervisor, &u->controller);
{% elif controller %}
  status = refer(u, message);
  control(u, &u->controller);
{% else %}
  (void)message;
{% endif %}
{% if machine %}
  {{ plant }}_step(&u->machine, u->value + {{ at.machine | default(0) }}, u->value + {{ at.command }}, {{ "1" if controller else "(u->value[" ~ at.gates ~ "] >= 0.5) ? 1 : 0" }}{% if wrench %}, u->value + {{ at.w }}{% endif %}{% if delay %}, {{ "1" if controller else "(u->value[" ~ at.late ~ "] != 0.0) ? 1 : 0" }}{% endif %});
  look(u);
{% endif %}
  return status;
}

/* One sample whose inputs are those of its beginning. */
static int sample_held(unit_data *u, const char **message) {
  int status;
  int32_t k;
  for (k = 0; k < UNIT_VARIABLES; k++) {
    const double now = u->value[k];
    u->value[k] = (roles[k] == 'i') ? u->held[k] : now;
    u->held[k] = now;
  }
  status = sample(u, message);
  for (k = 0; k < UNIT_VARIABLES; k++) {
    u->value[k] = (roles[k] == 'i') ? u->held[k] : u->value[k];
  }
  return status;
}
{% if checked %}

/* A machine has no gate: a number that is none would never leave its state. */
static int all_finite(const double *values, int32_t count) {
  int32_t k;
  int found = 1;
  for (k = 0; k < count; k++) {
    if (is_finite(values[k]) == 0) {
      found = 0;
    }
  }
  return found;
}
{% endif %}

int unit_advance(unit_data *u, double from, double step, const char **message) {
  const double whole = step / UNIT_SAMPLE_TIME;
  const double apart = from - u->value[0];
  int status = UNIT_OK;
  double left = whole;
  if (u->phase != UNIT_RUNNING) {
    return refuse(message, "a step outside of the simulation");
  }
  if (!((whole >= 1e-3) && (whole < 1e12))) {
    return refuse(message, "a step that is shorter than a thousandth of the sample time, or endless");
  }
  if (!((apart < 1e-3 * UNIT_SAMPLE_TIME) && (apart > -1e-3 * UNIT_SAMPLE_TIME))) {
    return refuse(message, "a step that does not begin where the last one ended");
  }
{% for f in checked %}
  if (all_finite(u->value + {{ f.at }}, {{ f.size }}) == 0) {
    return refuse(message, "an input {{ f.name }} that is no finite number");
  }
{% endfor %}
  while (left > STEP_ROUNDING) {
    const double rest = 1.0 - u->share;
    if (u->share == 0.0) {
      memcpy(u->held, u->value, sizeof u->held);
    }
    if (left < (rest - STEP_ROUNDING)) {
      u->share = u->share + left;
      left = 0.0;
    } else {
      const int found = sample_held(u, message);
      status = (found > status) ? found : status;
      u->share = 0.0;
      left = left - rest;
    }
  }
  u->value[0] = from + step;
{% if machine %}
  if (all_finite(u->value + {{ at.x }}, {{ states }}) == 0) {
    return refuse(message, "the machine's state is no finite number any more");
  }
{% endif %}
  return status;
}

int unit_end(unit_data *u, const char **message) {
  if (u->phase != UNIT_RUNNING) {
    return refuse(message, "an end outside of the simulation");
  }
  u->phase = UNIT_ENDED;
  return UNIT_OK;
}

size_t unit_bytes(void) { return sizeof UNIT_TOKEN + sizeof(unit_data); }

void unit_write(const unit_data *u, unsigned char *bytes) {
  memcpy(bytes, UNIT_TOKEN, sizeof UNIT_TOKEN);
  memcpy(bytes + sizeof UNIT_TOKEN, u, sizeof *u);
}

int unit_read(unit_data *u, const unsigned char *bytes, const char **message) {
{% if controller %}
  {{ name }}_state fresh;
{% endif %}
  if (memcmp(bytes, UNIT_TOKEN, sizeof UNIT_TOKEN) != 0) {
    return refuse(message, "a state of another unit");
  }
  memcpy(u, bytes + sizeof UNIT_TOKEN, sizeof *u);
{% if controller %}
  {{ name }}_init(&fresh); /* addresses of the table are this process's own */
  u->controller.z = fresh.z;
  u->controller.v0 = fresh.v0;
{% endif %}
  return UNIT_OK;
}
