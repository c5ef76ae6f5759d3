/* {{ title }}: see {{ name }}_supervisor.h. Written by malta {{ version }}. */
#include "{{ name }}_supervisor.h"

#include <stdbool.h>
{% if tunable %}
#include <stddef.h>
{% endif %}
{% include "exact.c" %}

{% include "arithmetic.c" %}

#define OUTPUTS {{ outputs }}
{% if fallback %}
#define STATES {{ estimated }} /* of the filter */
{% endif %}
#define EVENT_NONE 0
#define EVENT_START 1
#define EVENT_DONE 2
#define EVENT_HOLD 3
#define EVENT_LAND 4
#define EVENT_FAULT 5
#define EVENT_ACKNOWLEDGE 6
{% if wiring %}
#define EVENT_WIRE 7
{% endif %}

const {{ name }}_monitor {{ name }}_monitors[{{ NAME }}_MONITOR_ROWS] = {
{% for row in rows %}
  { {{ NAME }}_MONITOR_{{ row.key }}, {{ row.threshold }}, {{ row.samples }}, {{ NAME }}_REACTION_{{ row.reaction }}, {{ row.states }}u },
{% endfor %}
};

typedef struct {
  int32_t from;
  int32_t event;
  int32_t to;
} transition;

static const {{ name }}_real near_touch[OUTPUTS] = { {{ touch }} };
static const {{ name }}_real range[OUTPUTS] = { {{ range }} };
static const {{ name }}_real sigma[OUTPUTS] = { {{ sigma }} }; /* of a reading */
{% if not tunable %}
static const {{ name }}_real farthest[OUTPUTS] = { {{ limits.position }} };   /* of references */
static const {{ name }}_real fastest[OUTPUTS] = { {{ limits.speed }} };
static const {{ name }}_real steepest[OUTPUTS] = { {{ limits.acceleration }} };
{% endif %}
{% set farthest = "sup->parameters->position" if tunable else "farthest" %}
{% set fastest = "sup->parameters->speed" if tunable else "fastest" %}
{% set steepest = "sup->parameters->acceleration" if tunable else "steepest" %}
{% set row_samples = "sup->parameters->samples[r]" if tunable else "row->samples" %}

static {{ name }}_real size_of({{ name }}_real value) { return (value < {{ zero }}) ? -value : value; }

static {{ name }}_real between({{ name }}_real low, {{ name }}_real value, {{ name }}_real high) {
  const {{ name }}_real bounded = (value > low) ? value : low;
  return (bounded < high) ? bounded : high;
}

static int32_t is_flying(int32_t state) {
  return ((state >= {{ NAME }}_LIFT) && (state <= {{ NAME }}_LANDING)) ? 1 : 0;
}

static bool is_lifting(const {{ name }}_supervisor *sup) {
  return (sup->state == {{ NAME }}_LIFT) || (sup->state == {{ NAME }}_LANDING);
}

/* A count and one, up to a number of samples that stands for ever: a machine may be off for days. */
static int32_t one_more(int32_t count) {
  int32_t more = count;
  if (count < {{ longest }}) {
    more++;
  }
  return more;
}

/* Whether a number is one, and of this size at most. */
static int32_t is_within({{ name }}_real value, {{ name }}_real most) {
  return ((value <= most) && (value >= -most)) ? 1 : 0;
}

/* A mean with one more value in it; what is no number is left out, or the mean would be none for ever. */
static {{ name }}_real mean_with({{ name }}_real mean, {{ name }}_real share, {{ name }}_real value) {
  {{ name }}_real next = mean;
  if (is_within(value, {{ most }}) == 1) {
    next = mean + (share * (value - mean));
  }
  return next;
}

/* Steps that were missed before a sample. */
static int32_t missed_of(const {{ name }}_request *request) {
  const int32_t some = (request->missed > 0) ? request->missed : 0;
  return (some < {{ most_missed }}) ? some : {{ most_missed }};
}

static void forget_sensors({{ name }}_supervisor *sup) {
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    sup->unbelieved[k] = 0;
    sup->agreed[k] = 0;
    sup->lapses[k] = 0;
    sup->repeated[k] = 0;
    sup->since[k] = {{ zero }};
    sup->limited[k] = {{ zero }};
    sup->noise[k] = {{ zero }};
    sup->error[k] = {{ zero }};
    sup->usual[k] = {{ zero }};
    sup->away[k] = {{ zero }};
    sup->shift[k] = {{ zero }};
  }
  for (k = 0; k < {{ rows | length * outputs }}; k++) {
    sup->count[k] = 0;
  }
  sup->unchanged = 0;
  sup->unrest = {{ zero }};
{% if currents %}
  for (k = 0; k < {{ axes }}; k++) {
    sup->off_mean[k] = {{ zero }};
    sup->beyond_mean[k] = {{ zero }};
  }
{% for _ in stars %}
  sup->still[{{ loop.index0 }}] = 0;
{% endfor %}
{% endif %}
}

void {{ name }}_supervisor_init({{ name }}_supervisor *sup) {
  int32_t k;
{% for key, value in times %}
  sup->times.{{ key }} = {{ value }};
{% endfor %}
  sup->state = {{ NAME }}_OFF;
  sup->monitor = -1;
  sup->reaction = {{ NAME }}_REACTION_NONE;
  sup->enable = 0;
  sup->fit = ({{ name }}_is_exact() == 1) ? {{ name }}_self_test() : 0;
  sup->started = 1; /* a request that is held while power comes on starts nothing */
  sup->acknowledged = 1;
  sup->overruns = 0;
  sup->followed = 0;
  sup->seeing = 0;
  sup->leapt = -1;
  sup->leap = {{ zero }};
  sup->steered = 0;
  sup->late = {{ zero }};
  sup->samples = 0;
  sup->steady = 0;
{% if tunable %}
  sup->parameters = &{{ name }}_default_parameters;
  sup->calibration = NULL;
  sup->refused = 0;
  sup->refused_entry = -1;
{% endif %}
  for (k = 0; k < {{ NAME }}_MONITOR_ROWS; k++) {
    sup->acted[k] = 0;
  }
  for (k = 0; k < OUTPUTS; k++) {
    sup->rest[k] = {{ zero }};
    sup->last[k] = {{ zero }};
    sup->place[k] = {{ zero }};
    sup->asked[k] = {{ zero }};
    sup->asked_rate[k] = {{ zero }};
    sup->paced[k] = 0;
    sup->d0[k] = {{ zero }};
    sup->d1[k] = {{ zero }};
    sup->d2[k] = {{ zero }};
    sup->lasts[k] = {{ NAME }}_SAMPLE_TIME;
    sup->stops[k] = {{ NAME }}_SAMPLE_TIME;
  }
{% if currents %}
  for (k = 0; k < {{ currents }}; k++) {
    sup->offset[k] = {{ zero }};
  }
  for (k = 0; k < {{ coils }}; k++) {
    sup->current[k] = {{ zero }};
  }
  for (k = 0; k < {{ currents }}; k++) {
    sup->i_before[k] = {{ zero }};
  }
  sup->commanded = 0;
{% endif %}
{% if stars %}
  for (k = 0; k < {{ currents }}; k++) {
    sup->raw_current[k] = {{ zero }};
    sup->same_current[k] = 0;
  }
  sup->inferred = 0;
{% endif %}
{% if wiring %}
  sup->wired = 0;
{% for member in wiring_members %}
{% if member.size %}
  for (k = 0; k < {{ member.size }}; k++) {
    sup->{{ member.name }}[k] = {{ zero if member.kind == "real" else 0 }};
  }
{% else %}
  sup->{{ member.name }} = {{ zero if member.kind == "real" else 0 }};
{% endif %}
{% endfor %}
{% endif %}
  forget_sensors(sup);
}

void {{ name }}_supervisor_take_over({{ name }}_supervisor *sup, const {{ name }}_real rest[OUTPUTS]) {
  int32_t k;
  {{ name }}_supervisor_init(sup);
  if (sup->fit == 1) {
    sup->state = {{ NAME }}_OPERATE;
    sup->enable = 1;
  }
  for (k = 0; k < OUTPUTS; k++) {
    sup->rest[k] = rest[k];
  }
}

{% include "root.c" %}

{% if not tracks_errors %}
{{ expectation }}
{% endif %}
{% if fallback %}
{{ correction }}
{% endif %}
{% if currents %}
{{ deviation }}
{% endif %}
{% if wiring %}
{% include "wiring.c" %}
{% endif %}
{% if rates %}
/* Over steps that were missed the machine has gone on: a filter that knows nothing of it would throw a stroke. */
static void coast({{ name }}_state *s, const {{ name }}_request *request) {
  const {{ name }}_real t = ({{ name }}_real)missed_of(request) * {{ NAME }}_SAMPLE_TIME;
  int32_t k;
  for (k = 0; k < {{ rates }}; k++) {
    const {{ name }}_real way = t * s->xi_pred[{{ rates }} + k];
    s->xi_pred[k] = s->xi_pred[k] + way;
  }
}

{% endif %}
/* What the filter expects of the readings; of a machine that does not fly, the readings themselves. */
static void expect(const {{ name }}_supervisor *sup, const {{ name }}_state *s, const {{ name }}_inputs *in,
                   {{ name }}_real expected[OUTPUTS]) {
  if (is_flying(sup->state) == 1) {
{% if tracks_errors %}
    int32_t k;
    for (k = 0; k < OUTPUTS; k++) {
      expected[k] = s->reference.p[k];
    }
{% else %}
    {{ name }}_expected(s->xi_pred, expected);
{% endif %}
  } else {
    int32_t k;
    for (k = 0; k < OUTPUTS; k++) {
      expected[k] = (is_within(in->y[k], range[k]) == 1) ? in->y[k] : {{ zero }};
    }
  }
}

/* What a reading will be off its reference soon, if the error grows on as it does: one that is lost doubles meanwhile. */
static {{ name }}_real error_ahead({{ name }}_supervisor *sup, {{ name }}_real error, int32_t k) {
  const {{ name }}_real counts = (is_flying(sup->state) == 1) ? error : {{ zero }};
  sup->error[k] = mean_with(sup->error[k], {{ error_share }}, counts);
  return counts + ({{ ahead }} * (counts - sup->error[k]));
}

{% if currents %}
/* How much more of an error is carried: a current off its command pushes the machine, and CURRENT_ERROR lands it.
   A lift and a landing have such room anyway. */
static {{ name }}_real carried(const {{ name }}_supervisor *sup) {
  {{ name }}_real times = {{ one }};
  int32_t k;
  for (k = 0; k < {{ axes }}; k++) {
    times = (!is_lifting(sup) && (size_of(sup->off_mean[k]) > {{ uncommanded }})) ? {{ freer }} : times;
  }
  return times;
}

{% endif %}
/* How far a reading may be: on the side where it rests a machine that lifts off or lands is at its bearing. */
static {{ name }}_real end_of(const {{ name }}_supervisor *sup, {{ name }}_real y, int32_t k) {
  const {{ name }}_real rests = size_of(sup->rest[k]) + ({{ beside }} * near_touch[k]);
  const bool same = is_lifting(sup) && ((y * sup->rest[k]) > {{ zero }});
  return (same && (rests > near_touch[k])) ? rests : near_touch[k];
}

/* Whether a reading is as near to a place as that of a machine that has settled. */
static int32_t is_near({{ name }}_real y, {{ name }}_real place, int32_t k) {
  static const {{ name }}_real settled[OUTPUTS] = { {{ settled }} };
  return is_within(y - place, settled[k]);
}

/* Whether a machine that lifts off or lands is off its bearing, by any of its sensors: on it, nothing moves. */
static bool has_left(const {{ name }}_supervisor *sup) {
  bool left = false;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    left = left || ({{ "(k != %d) && "|format(stroke_output) if stroke_output >= 0 }}(is_near(sup->last[k], sup->rest[k], k) == 0));
  }
  return left;
}

/* A sensor that repeats a reading, as a share of what noise allows; or of the way that its reference has gone since. */
static {{ name }}_real stuck_level({{ name }}_supervisor *sup, {{ name }}_real reference, int32_t k) {
  static const int32_t same_values[OUTPUTS] = { {{ stuck }} }; /* in a row, from which on a sensor is stuck */
  static const {{ name }}_real unmoved[OUTPUTS] = { {{ unmoved }} };
  {{ name }}_real level = ({{ name }}_real)sup->repeated[k] / ({{ name }}_real)same_values[k];
  if (sup->repeated[k] == 0) {
    sup->since[k] = reference;
  }
  if (is_lifting(sup) && (sup->repeated[k] >= {{ repeats }}) && has_left(sup)) {
    const {{ name }}_real gone = size_of(reference - sup->since[k]) / unmoved[k];
    level = (gone > level) ? gone : level;
  }
  return level;
}

/* Whether a sensor that is ignored reads what the filter expects. A filter alone knows less from sample to sample, so
   what it may differ by grows: no further than a share of the clearance, and in flight not for long; in a landing for a
   moment alone, as a law that follows a wrong reading would not meet its bearing slowly. */
static int32_t agrees(const {{ name }}_supervisor *sup, {{ name }}_real away, {{ name }}_real moved, {{ name }}_real deviation, int32_t k) {
  static const {{ name }}_real drift[OUTPUTS] = { {{ drift }} }; /* of what the filter expects alone, per sample^2 */
  static const {{ name }}_real nearest[OUTPUTS] = { {{ nearest }} };
  const {{ name }}_real age = ({{ name }}_real)sup->unbelieved[k];
  const {{ name }}_real grown = ({{ believed }} * deviation) + ((age * age) * drift[k]);
  const {{ name }}_real strange = away - sup->usual[k]; /* a filter that a bearing pushes is off while all is well */
  const bool lands = sup->state == {{ NAME }}_LANDING;
  const bool soon = (is_flying(sup->state) == 0) || (sup->unbelieved[k] <= (lands ? {{ bridged }} : {{ unbelieved }}));
  const bool calm = (sup->agreed[k] == 0) || (moved <= ({{ jump_deviations }} * deviation)); /* it may leap back once */
  return (soon && calm && (strange <= ((grown < nearest[k]) ? grown : nearest[k]))) ? 1 : 0;
}

/* Good readings until an ignored sensor is believed again: four times as many for each time that it was wrong lately, and
   one of a sensor that had none for a moment. */
static int32_t needed_of(const {{ name }}_supervisor *sup, int32_t k) {
  const bool paused = (sup->lapses[k] == 0) && (sup->unbelieved[k] <= {{ bridged }});
  int32_t needed = {{ agreement }};
  int32_t j;
  if (paused) {
    needed = 1;
  }
  for (j = 1; j < {{ most_lapses }}; j++) {
    if (j < sup->lapses[k]) {
      needed = 4 * needed;
    }
  }
  return needed;
}

/* By how much a sensor is noisier than it is said to be, 1 at least. */
static {{ name }}_real excess_noise(const {{ name }}_supervisor *sup, int32_t k) {
  const {{ name }}_real times = sup->noise[k] / ({{ mean_jump }} * sigma[k]);
  return (times > {{ one }}) ? times : {{ one }};
}

/* Levels of the monitors of each position sensor. */
static void look_at_sensor({{ name }}_supervisor *sup, const {{ name }}_inputs *in, int32_t missed, int32_t k,
                           {{ name }}_real expected, {{ name }}_real reference,
                           {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  static const {{ name }}_real jump[OUTPUTS] = { {{ jump }} }; /* from sample to sample */
  static const {{ name }}_real astray[OUTPUTS] = { {{ astray }} }; /* off a reference */
  const {{ name }}_real y = in->y[k];
  const int32_t is_number = is_within(y, {{ most }});
  if ((is_number == 1) && (in->y_valid[k] > {{ half }})) { /* a NaN is no yes */
    const {{ name }}_real moved = size_of(y - sup->last[k]);
    const {{ name }}_real away = size_of(y - expected);
    const {{ name }}_real counted = (moved < jump[k]) ? moved : jump[k]; /* a jump is no noise */
    {{ name }}_real more;
    if (sup->unbelieved[k] == 0) {
      sup->noise[k] = mean_with(sup->noise[k], {{ memory }}, counted);
    }
    more = excess_noise(sup, k);
    sup->repeated[k] = (y == sup->last[k]) ? one_more(sup->repeated[k]) : 0;
    level[{{ NAME }}_MONITOR_RANGE][k] = size_of(y) / range[k];
    level[{{ NAME }}_MONITOR_STUCK][k] = stuck_level(sup, reference, k);
    if (sup->unbelieved[k] == 0) {
      const int32_t steps = missed + 1;
      sup->usual[k] = mean_with(sup->usual[k], {{ error_share }}, (away < jump[k]) ? away : jump[k]);
      level[{{ NAME }}_MONITOR_TOUCH][k] = size_of(y) / end_of(sup, y, k);
      level[{{ NAME }}_MONITOR_FOLLOWING][k] = size_of(error_ahead(sup, y - reference, k)) / {{ "(carried(sup) * astray[k])" if currents else "astray[k]" }};
      const {{ name }}_real wider = {{ jump_deviations }} * (sigma[k] * (more - {{ one }}));
      level[{{ NAME }}_MONITOR_RATE][k] = moved / ((jump[k] + wider) * ({{ name }}_real)steps);
      level[{{ NAME }}_MONITOR_INNOVATION][k] = away / (sigma[k] * more);
{% if stroke_output >= 0 %}
      /* a filter without a sensor, or after a missed step, expects less well */
      const bool whole = (sup->seeing == OUTPUTS) && (sup->late < {{ recent_miss }});
      level[{{ NAME }}_MONITOR_STROKE][k] = (whole && (k == {{ stroke_output }})) ? (away / (sigma[k] * more)) : {{ zero }};
{% endif %}
    } else {
      sup->error[k] = y - reference; /* what it is off when it is believed again is no growth */
      sup->agreed[k] = (agrees(sup, away, moved, sigma[k] * more, k) == 1) ? one_more(sup->agreed[k]) : 0;
      if (sup->agreed[k] < needed_of(sup, k)) {
        level[{{ NAME }}_MONITOR_UNBELIEVED][k] = {{ one }};
      }
    }
    sup->last[k] = y;
  } else {
    level[{{ NAME }}_MONITOR_NAN][k] = {{ one }};
    sup->agreed[k] = 0;
    sup->repeated[k] = 0;
    sup->since[k] = reference;
  }
}

{% if leaps %}
/* Whether a sensor that leapt is back within some samples, as one that is noisy is and one that drifts is not. */
static bool is_back(const {{ name }}_supervisor *sup, {{ name }}_real away, int32_t k) {
  const {{ name }}_real most = {{ three }} * size_of(sup->leap);
  const bool near = (is_within(away, most) == 1) && ((away * sup->leap) < ({{ half }} * (sup->leap * sup->leap)));
  return (k == sup->leapt) && (sup->unbelieved[k] <= {{ held }}) && near;
}

/* The leap of a sensor that is back was noise. */
static void learn_noise({{ name }}_supervisor *sup, {{ name }}_real away, int32_t k) {
  const {{ name }}_real noise = {{ quarter }} * size_of(sup->leap);
  sup->noise[k] = (noise > sup->noise[k]) ? noise : sup->noise[k];
  sup->away[k] = between(-range[k], away, range[k]);
}

/* The most of sensors that are believed: what the filter expects of the others follows the noisiest. Along a stroke
   readings change by themselves. */
static {{ name }}_real most_excess_noise(const {{ name }}_supervisor *sup) {
  {{ name }}_real most = {{ one }};
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    const {{ name }}_real more = excess_noise(sup, k);
    most = ({{ "(k != %d) && "|format(stroke_output) if stroke_output >= 0 }}(sup->unbelieved[k] == 0) && (more > most)) ? more : most;
  }
  return most;
}

/* A reading that leaps from sample to sample off what the filter expects, by more than noise and the machine can do, is
   wrong, unless it is back soon: the law would take it for a speed, and throw the machine. A filter that follows a reading that is wrong by less is
   off those that are right within some samples: nothing tells which, and a fall is softer than what the law would do. So
   it is for a filter without a sensor that is off the others. */
static void look_for_leaps({{ name }}_supervisor *sup, const {{ name }}_inputs *in, int32_t missed,
                           const {{ name }}_real expected[OUTPUTS], {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  static const {{ name }}_real leap[OUTPUTS] = { {{ leap }} };
  const {{ name }}_real times = (sup->state == {{ NAME }}_LIFT) ? {{ freer }} : {{ one }}; /* a bearing pushes */
  const {{ name }}_real rougher = most_excess_noise(sup);
  const bool flies = is_flying(sup->state) == 1;
  const bool whole = sup->seeing == OUTPUTS;
  const bool counts = (missed == 0) && (sup->late < {{ recent_miss }}); /* after a missed step a filter expects less well */
  {{ name }}_real most_leapt = {{ one }};
  {{ name }}_real first = {{ zero }};
  {{ name }}_real second = {{ zero }};
  int32_t wrong = -1;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if ((k == sup->leapt) && (sup->unbelieved[k] == 0)) {
      sup->leapt = -1; /* what comes next is another fault */
    }
    if ((sup->unbelieved[k] == 0) && (level[{{ NAME }}_MONITOR_NAN][k] < {{ half }})) {
      const {{ name }}_real most = rougher * leap[k];
      const {{ name }}_real away = in->y[k] - expected[k];
      const {{ name }}_real off = size_of(away - sup->shift[k]) / most;
      const {{ name }}_real change = size_of(away - sup->away[k]) / most;
      const {{ name }}_real leapt = (change < off) ? change : off;
      const bool again = ((away - sup->shift[k]) * (sup->away[k] - sup->shift[k])) > {{ zero }}; /* noise is not */
      const {{ name }}_real calm = (again && (off > ({{ apart_from_others }} * sup->unrest))) ? off : {{ zero }};
      const {{ name }}_real lost = whole ? (calm / ({{ lost_with_all }} * times)) : (size_of(away) / ({{ lost_alone }} * most));
      if (leapt > most_leapt) {
        most_leapt = leapt;
        wrong = k;
      }
      second = between(second, change, first);
      first = (change > first) ? change : first;
      if (flies && counts && (lost > level[{{ NAME }}_MONITOR_ASTRAY][k])) {
        level[{{ NAME }}_MONITOR_ASTRAY][k] = lost;
      }
      sup->away[k] = between(-range[k], away, range[k]);
      sup->shift[k] = mean_with(sup->shift[k], {{ error_share }}, sup->away[k]);
    } else if ((level[{{ NAME }}_MONITOR_NAN][k] < {{ half }}) && is_back(sup, in->y[k] - expected[k], k)) {
      learn_noise(sup, in->y[k] - expected[k], k);
      level[{{ NAME }}_MONITOR_UNBELIEVED][k] = {{ zero }};
    } else {
      /* it is ignored on */
    }
  }
  /* where all are noisy none is wrong */
  if (flies && counts && whole && (wrong >= 0) && (most_leapt > ({{ two }} * second)) &&
      (most_leapt > ({{ apart_from_others }} * sup->unrest))) {
    sup->leapt = (level[{{ NAME }}_MONITOR_RATE][wrong] > {{ one }}) ? -1 : wrong;
    sup->leap = sup->away[wrong];
    level[{{ NAME }}_MONITOR_RATE][wrong] = most_leapt;
  }
  sup->unrest = mean_with(sup->unrest, {{ error_share }}, second);
}

{% endif %}
/* Levels of the monitors that look at all position sensors together. */
static void look_at_sensors({{ name }}_supervisor *sup, {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  int32_t repeated = 1;
  int32_t believed = 0;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if (sup->repeated[k] == 0) {
      repeated = 0;
    }
    if (sup->unbelieved[k] == 0) {
      believed++;
    }
  }
  sup->seeing = believed;
  sup->unchanged = (repeated == 1) ? one_more(sup->unchanged) : 0;
  for (k = 0; k < OUTPUTS; k++) {
    level[{{ NAME }}_MONITOR_STALE][k] = ({{ name }}_real)sup->unchanged;
  }
  level[{{ NAME }}_MONITOR_BLIND][0] = (believed == 0) ? {{ one }} : {{ zero }};
  for (k = 0; k < OUTPUTS; k++) {
    /* a filter that lost its way would throw the machine against its bearings */
    level[{{ NAME }}_MONITOR_HELPLESS][k] = (believed < OUTPUTS) ? sup->limited[k] : {{ zero }};
  }
}

/* Whether a requested reference is within its limits, and near enough to that of the sample before. */
static int32_t is_reference(const {{ name }}_supervisor *sup, const {{ name }}_request *request) {
{% if tunable %}
  const {{ name }}_real *const most = sup->parameters->position;
{% else %}
  const {{ name }}_real *const most = farthest;
{% endif %}
  const {{ name }}_reference *r = &request->reference;
  const int32_t steps = missed_of(request) + 1;
  const {{ name }}_real h = ({{ name }}_real)steps * {{ NAME }}_SAMPLE_TIME;
  int32_t accepted = 1;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    const int32_t here = is_within(r->p[k], most[k]);
    const int32_t slow = is_within(r->dp[k], {{ fastest }}[k]);
    const int32_t even = is_within(r->ddp[k], {{ steepest }}[k]);
    if ((here + slow + even) != 3) {
      accepted = 0;
    } else if ((sup->state == {{ NAME }}_OPERATE) && (sup->followed == 1)) {
      const {{ name }}_real far = ({{ rounding }} * most[k]) + ({{ fastest }}[k] * h);
      const {{ name }}_real faster = ({{ rounding }} * {{ fastest }}[k]) + ({{ steepest }}[k] * h);
      if ((is_within(r->p[k] - sup->asked[k], far) + is_within(r->dp[k] - sup->asked_rate[k], faster)) != 2) {
        accepted = 0;
      }
    } else {
      /* what it begins with is faded to */
    }
  }
  return accepted;
}

/* The last reference that was requested in numbers of possible size: what the next one steps from. Its rate is used where
   it is that of its places, else the place alone. */
static void remember({{ name }}_supervisor *sup, const {{ name }}_request *request) {
  const {{ name }}_reference *r = &request->reference;
  const int32_t steps = missed_of(request) + 1;
  const {{ name }}_real h = ({{ name }}_real)steps * {{ NAME }}_SAMPLE_TIME;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    const {{ name }}_real way = ({{ half }} * h) * (r->dp[k] + sup->asked_rate[k]);
    const {{ name }}_real most = ({{ rounding }} * range[k]) + ({{ steepest }}[k] * (h * h));
    sup->paced[k] = 0;
    if ((sup->followed == 1) && (is_within((r->p[k] - sup->asked[k]) - way, most) == 1)) {
      sup->paced[k] = 1;
    }
    if ((is_within(r->p[k], range[k]) == 1) && (is_within(r->dp[k], {{ most_rate }}) == 1)) {
      sup->asked[k] = r->p[k];
      sup->asked_rate[k] = r->dp[k];
      sup->followed = 1;
    }
  }
}
{% if currents %}

/* 1 where a current has a reading that is a number of possible size. */
static int32_t has_current(const {{ name }}_inputs *in, int32_t k) {
  return ((is_within(in->i[k], {{ most }}) == 1) && (in->i_valid[k] > {{ half }})) ? 1 : 0;
}
{% endif %}
{% if stars %}

static const int32_t stars[{{ stars | length }}][{{ stars[0] | length }}] = { {% for star in stars %}{ {{ star | join(", ") }} }{{ ", " if not loop.last }}{% endfor %} };

/* Counts readings that repeat: {{ longest }} from when one is known to be frozen, as its star is uneven, until it changes. */
static int32_t is_frozen({{ name }}_supervisor *sup, int32_t k, {{ name }}_real i, {{ name }}_real sum) {
  const bool same = (is_flying(sup->state) == 1) && (i == sup->raw_current[k]);
  const int32_t repeats = same ? one_more(sup->same_current[k]) : 0;
  const bool uneven = (repeats >= {{ frozen_samples }}) && (size_of(sum) > {{ uneven }});
  sup->raw_current[k] = (is_within(i, {{ most }}) == 1) ? i : {{ zero }};
  sup->same_current[k] = uneven ? {{ longest }} : repeats;
  return (sup->same_current[k] == {{ longest }}) ? 1 : 0;
}

/* A current whose reading is lost or frozen is known by the others of its star, which add up to zero with it. */
static void infer_currents({{ name }}_supervisor *sup, {{ name }}_inputs *seen) {
  int32_t s;
  sup->inferred = 0;
  for (s = 0; s < {{ stars | length }}; s++) {
    {{ name }}_real sum = {{ zero }};
    {{ name }}_real moved = {{ zero }};
    int32_t lost = 0;
    int32_t which = 0;
    int32_t j;
    for (j = 0; j < {{ stars[0] | length }}; j++) {
      const int32_t k = stars[s][j];
      if (has_current(seen, k) == 1) {
        sum = sum + seen->i[k];
      }
    }
    for (j = 0; j < {{ stars[0] | length }}; j++) {
      const int32_t k = stars[s][j];
      const int32_t frozen = is_frozen(sup, k, seen->i[k], sum);
      if ((has_current(seen, k) == 1) && (frozen == 0)) {
        moved = moved + seen->i[k];
      } else {
        lost++;
        which = k;
      }
    }
    if (lost == 1) {
      seen->i[which] = -moved;
      seen->i_valid[which] = {{ one }};
      sup->inferred++;
    }
  }
}
{% endif %}
{% if currents %}

/* Levels of the monitors of currents and of the link; no reading of a current is used that is no number. */
static void look_at_currents({{ name }}_supervisor *sup, const {{ name }}_inputs *in,
                             const {{ name }}_real expected[OUTPUTS],
                             {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  int32_t k;
  for (k = 0; k < {{ currents }}; k++) {
    if (has_current(in, k) == 0) {
      level[{{ NAME }}_MONITOR_CURRENT_LOST][0] = {{ one }};
    } else if (size_of(in->i[k]) > level[{{ NAME }}_MONITOR_CURRENT][0]) {
      level[{{ NAME }}_MONITOR_CURRENT][0] = size_of(in->i[k]);
    } else {
      /* smaller than another */
    }
    if ((sup->samples >= sup->times.offsets) && (size_of(sup->offset[k]) > level[{{ NAME }}_MONITOR_OFFSET][0])) {
      level[{{ NAME }}_MONITOR_OFFSET][0] = size_of(sup->offset[k]);
    }
  }
{% if stars %}
  level[{{ NAME }}_MONITOR_CURRENT_INFERRED][0] = ({{ name }}_real)sup->inferred;
{% endif %}
  level[{{ NAME }}_MONITOR_LINK][0] = {{ one }};
  if (is_within(in->link[0], {{ most }}) == 1) {
    level[{{ NAME }}_MONITOR_LINK][0] = {{ one }} - (in->link[0] / {{ link }});
    level[{{ NAME }}_MONITOR_OVERVOLTAGE][0] = (in->link[0] / {{ link }}) - {{ one }};
  }
  if (level[{{ NAME }}_MONITOR_CURRENT_LOST][0] < {{ half }}) {
{% if stars %}
    for (k = 0; k < {{ stars | length }}; k++) {
      {{ name }}_real sum = {{ zero }};
      int32_t same = 1;
      int32_t j;
      for (j = 0; j < {{ stars[0] | length }}; j++) {
        sum = sum + in->i[stars[k][j]];
        same = (in->i[stars[k][j]] == sup->i_before[stars[k][j]]) ? same : 0;
      }
      if (size_of(sum) > level[{{ NAME }}_MONITOR_CURRENT_SUM][0]) {
        level[{{ NAME }}_MONITOR_CURRENT_SUM][0] = size_of(sum);
      }
      sup->still[k] = ((same == 1) && (sup->commanded == 1)) ? one_more(sup->still[k]) : 0;
      if (({{ name }}_real)sup->still[k] > level[{{ NAME }}_MONITOR_CURRENT_FROZEN][0]) {
        level[{{ NAME }}_MONITOR_CURRENT_FROZEN][0] = ({{ name }}_real)sup->still[k];
      }
    }
{% endif %}
    {{ name }}_real off[{{ axes }}];
    {{ name }}_real beyond[{{ axes }}];
    {{ name }}_deviation(in->i, expected, sup->current, off, beyond);
    for (k = 0; k < {{ axes }}; k++) {
      /* a link without voltage is told by its own monitor */
      const bool told = level[{{ NAME }}_MONITOR_LINK][0] <= {{ sagging }};
      const {{ name }}_real now = told ? off[k] : {{ zero }};
      const {{ name }}_real more = told ? beyond[k] : {{ zero }};
      sup->off_mean[k] = mean_with(sup->off_mean[k], {{ mean_share }}, now);
      sup->beyond_mean[k] = mean_with(sup->beyond_mean[k], {{ mean_share }}, more);
      if (size_of(sup->off_mean[k]) > level[{{ NAME }}_MONITOR_CURRENT_ERROR][0]) {
        level[{{ NAME }}_MONITOR_CURRENT_ERROR][0] = size_of(sup->off_mean[k]);
      }
      if (sup->beyond_mean[k] > level[{{ NAME }}_MONITOR_CURRENT_EXCESS][0]) {
        level[{{ NAME }}_MONITOR_CURRENT_EXCESS][0] = sup->beyond_mean[k];
      }
    }
    for (k = 0; k < {{ currents }}; k++) {
      sup->i_before[k] = in->i[k];
    }
  }
}
{% endif %}

/* Whether the filter lost its way: it expects what cannot be read or, without a sensor, to be where no reference is. */
static int32_t is_astray(const {{ name }}_supervisor *sup, {{ name }}_real expected, {{ name }}_real reference, int32_t k) {
  int32_t ignored = 0;
  int32_t j;
  for (j = 0; j < OUTPUTS; j++) {
    if (sup->unbelieved[j] > 0) {
      ignored = 1;
    }
  }
  const bool lost = (ignored == 1) && (size_of(expected - reference) > near_touch[k]);
  return (lost || (is_within(expected, range[k]) == 0)) ? 1 : 0;
}

/* Levels of all monitors at a sample. */
static void look({{ name }}_supervisor *sup, const {{ name }}_state *s, const {{ name }}_inputs *in,
                 const {{ name }}_request *request, const {{ name }}_real expected[OUTPUTS],
                 {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  const int32_t missed = missed_of(request);
  int32_t k;
  int32_t m;
  for (m = 0; m < {{ monitors | length }}; m++) {
    for (k = 0; k < OUTPUTS; k++) {
      level[m][k] = {{ zero }};
    }
  }
  for (k = 0; k < OUTPUTS; k++) {
    look_at_sensor(sup, in, missed, k, expected[k], s->reference.p[k], level);
    level[{{ NAME }}_MONITOR_SATURATION][k] = sup->limited[k];
    if (is_flying(sup->state) == 1) {
      const int32_t astray = is_astray(sup, expected[k], s->reference.p[k], k);
      level[{{ NAME }}_MONITOR_ASTRAY][k] = (astray == 1) ? {{ two }} : {{ zero }};
    }
  }
  look_at_sensors(sup, level);
{% if leaps %}
  look_for_leaps(sup, in, missed, expected, level);
{% endif %}
  level[{{ NAME }}_MONITOR_MISSED][0] = ({{ name }}_real)missed;
  sup->overruns = (missed > 0) ? one_more(sup->overruns) : sup->overruns;
  sup->late = mean_with(sup->late, {{ memory }}, (missed > 0) ? {{ one }} : {{ zero }});
  level[{{ NAME }}_MONITOR_OVERRUN][0] = sup->late;
  level[{{ NAME }}_MONITOR_STOP][0] = (request->stop != 0) ? {{ one }} : {{ zero }};
  level[{{ NAME }}_MONITOR_STO][0] = (request->sto != 0) ? {{ one }} : {{ zero }};
  level[{{ NAME }}_MONITOR_REFERENCE][0] = (is_reference(sup, request) == 1) ? {{ zero }} : {{ one }};
  level[{{ NAME }}_MONITOR_UNSETTLED][0] = ({{ name }}_real)sup->samples;
  level[{{ NAME }}_MONITOR_UNREADY][0] = ({{ name }}_real)sup->samples;
{% if wiring %}
  level[{{ NAME }}_MONITOR_WIRING][0] = (sup->wired == -1) ? {{ one }} : {{ zero }};
{% endif %}
{% if currents %}
  look_at_currents(sup, in, expected, level);
{% endif %}
}

/* Count every row of the table; the strongest reaction of those that act. */
static int32_t judge({{ name }}_supervisor *sup, {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  int32_t strongest = {{ NAME }}_REACTION_NONE;
  int32_t calm = 1;
  int32_t entry = 0; /* of a row and an output in the counts */
  bool refused[OUTPUTS];
  int32_t r;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    /* an unbelieved sensor stays so while it is far from what is expected */
    refused[k] = level[{{ NAME }}_MONITOR_UNBELIEVED][k] > {{ half }};
  }
  for (r = 0; r < {{ NAME }}_MONITOR_ROWS; r++) {
    const {{ name }}_monitor *row = &{{ name }}_monitors[r];
    const bool counts = ((row->states >> (uint32_t)sup->state) & 1u) == 1u;
    int32_t acts = 0;
    for (k = 0; k < OUTPUTS; k++) {
      int32_t count = 0;
      {{ name }}_real now = level[row->monitor][k];
      if (row->monitor == {{ NAME }}_MONITOR_UNBELIEVED) {
        now = (sup->unbelieved[k] > 0) ? {{ one }} : {{ zero }};
      }
      if (counts && (now > {{ "sup->parameters->threshold[r]" if tunable else "row->threshold" }})) {
        count = one_more(sup->count[entry]);
        if (row->reaction == {{ NAME }}_REACTION_HOLD) {
          calm = 0;
        }
        if (count >= {{ row_samples }}) {
          acts = 1;
          if (row->reaction == {{ NAME }}_REACTION_IGNORE) {
            refused[k] = true;
          }
          if (count == {{ row_samples }}) {
            sup->monitor = row->monitor;
            sup->reaction = row->reaction;
            sup->acted[r] = one_more(sup->acted[r]);
          }
        }
      }
      sup->count[entry] = count;
      entry++;
    }
    if ((acts == 1) && (row->reaction > strongest)) {
      strongest = row->reaction;
    }
  }
  for (k = 0; k < OUTPUTS; k++) {
    if (refused[k] && (sup->unbelieved[k] == 0)) {
      /* no reading is no wrong one, nor is one that repeats */
      const bool lied = (level[{{ NAME }}_MONITOR_RANGE][k] > {{ one }}) || ((level[{{ NAME }}_MONITOR_RATE][k] > {{ one }}) && (k != sup->leapt));
      sup->lapses[k] = (lied && (sup->lapses[k] < {{ most_lapses }})) ? (sup->lapses[k] + 1) : sup->lapses[k];
      sup->agreed[k] = 0;
    } else if (!refused[k]) {
      sup->agreed[k] = one_more(sup->agreed[k]);
      if (sup->agreed[k] > {{ lapse_samples }}) {
        sup->lapses[k] = (sup->lapses[k] > 0) ? (sup->lapses[k] - 1) : 0;
        sup->agreed[k] = 0;
      }
    } else {
      /* it is ignored on */
    }
    sup->unbelieved[k] = refused[k] ? one_more(sup->unbelieved[k]) : 0;
    if (refused[k] && (sup->state == {{ NAME }}_SENSORS)) {
      calm = 0;
    }
  }
  if ((sup->state == {{ NAME }}_HOLD) || (sup->state == {{ NAME }}_SENSORS)) {
    sup->steady = (calm == 1) ? one_more(sup->steady) : 0;
  }
  return strongest;
}

{% if currents %}
/* Average the readings of the current sensors while there is no current. */
static void average_currents({{ name }}_supervisor *sup, const {{ name }}_inputs *in) {
  const int32_t number = sup->samples + 1;
  int32_t k;
  for (k = 0; k < {{ currents }}; k++) {
    if (is_within(in->i[k], {{ most }}) == 1) {
      const {{ name }}_real more = (in->i[k] - sup->offset[k]) / ({{ name }}_real)number;
      sup->offset[k] = sup->offset[k] + more;
    } else {
      sup->offset[k] = {{ most }}; /* a sensor without a number has no offset: refused */
    }
  }
}

{% endif %}
/* Average the readings of a machine at rest: the place where it lands again. One that slides begins anew. */
static void average_rest({{ name }}_supervisor *sup) {
  const int32_t number = (sup->steady > 0) ? sup->steady : 1;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if ((number > 1) && (is_near(sup->last[k], sup->rest[k], k) == 0)) {
      sup->steady = 0;
    }
  }
  for (k = 0; k < OUTPUTS; k++) {
    const {{ name }}_real more = (sup->last[k] - sup->rest[k]) / ({{ name }}_real)number;
    sup->rest[k] = sup->rest[k] + more;
  }
}

/* Samples in a row at which a machine that lands without one of its sensors is where it rested, by the others. */
static void count_landed({{ name }}_supervisor *sup, const {{ name }}_inputs *in) {
  int32_t ignored = 0;
{% if not only_stroke %}
  int32_t there = 0;
  int32_t away = 0;
{% endif %}
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if (sup->unbelieved[k] > 0) {
      ignored = 1;
{% if only_stroke %}
    }
{% else %}
    } else if (is_near(in->y[k], sup->rest[k], k) == 1) {
      there = {{ "(%s) ? 1 : there"|format(landed_by) if landed_by else "1" }};
    } else {
      away{{ " = (k != %d) ? 1 : away"|format(stroke_output) if stroke_output >= 0 else " = 1" }};
    }
{% endif %}
  }
{% if only_stroke %}
  (void)in; /* a stroke may rest anywhere */
  sup->steady = (ignored == 1) ? one_more(sup->steady) : 0;
{% else %}
  sup->steady = ((ignored == 1) && (there == 1) && (away == 0)) ? one_more(sup->steady) : 0; /* none that is left tells nothing */
{% endif %}
}

/* Samples in a row with errors of a machine that has settled. */
static void count_settled({{ name }}_supervisor *sup, const {{ name }}_state *s, const {{ name }}_inputs *in) {
  int32_t k;
  sup->steady = one_more(sup->steady);
  for (k = 0; k < OUTPUTS; k++) {
    if ((sup->unbelieved[k] > 0) || (is_near(in->y[k], s->reference.p[k], k) == 0)) {
      sup->steady = 0;
    }
  }
  if (sup->steady >= sup->times.settle) {
    sup->samples = 0; /* it has settled, and waits for its request */
  }
}

/* Whether the reference has reached its place: at rest. */
static bool is_at_rest(const {{ name }}_supervisor *sup) {
  const {{ name }}_real t = ({{ name }}_real)sup->samples * {{ NAME }}_SAMPLE_TIME;
  bool rests = sup->steered == 0;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    rests = rests && (t >= sup->lasts[k]);
  }
  return rests;
}

/* What a state waits for. */
static bool is_done(const {{ name }}_supervisor *sup, const {{ name }}_request *request) {
  bool done;
  switch (sup->state) {
  case {{ NAME }}_OFFSETS:
    done = sup->samples > sup->times.offsets; /* one more, in which the offsets are judged */
    break;
  case {{ NAME }}_SENSORS:
    done = sup->steady >= sup->times.check;
    break;
{% if wiring %}
  case {{ NAME }}_WIRING:
    done = sup->wired == 1;
    break;
{% endif %}
  case {{ NAME }}_LIFT:
    done = sup->samples >= sup->times.lift;
    break;
  case {{ NAME }}_SETTLE:
    done = (sup->steady >= sup->times.settle) && (request->operate != 0) && (is_reference(sup, request) == 1);
    break;
  case {{ NAME }}_HOLD:
    done = (sup->steady >= sup->times.calm) && is_at_rest(sup); /* one that moves would go on beyond its end */
    break;
  case {{ NAME }}_LANDING:
    done = (sup->samples >= (sup->times.landing + sup->times.settle)) || (sup->steady > 0);
    break;
  default:
    done = false;
    break;
  }
  return done;
}

/* Whether a machine that is off may start: when it is asked to, not while it is, with the arithmetic of this text. */
static bool is_startable(const {{ name }}_supervisor *sup, const {{ name }}_request *request) {
  const bool asked = (request->start != 0) && (sup->started == 0);
{% if tunable %}
  const bool ready = asked && (sup->state == {{ NAME }}_OFF) && (sup->fit == 1);
  return ready && ({{ name }}_accepts_parameters(sup->parameters) == 1); /* they may have changed in their memory */
{% else %}
  return asked && (sup->state == {{ NAME }}_OFF) && (sup->fit == 1);
{% endif %}
}

{% if tunable %}
/* Why a start is refused. */
static void refuse_start({{ name }}_supervisor *sup, const {{ name }}_request *request) {
  if ((request->start != 0) && (sup->started == 0) && (sup->state == {{ NAME }}_OFF)) {
    sup->refused_entry = -1;
    if (sup->fit != 1) {
      sup->refused = {{ NAME }}_START_ARITHMETIC;
    } else if ((request->stop != 0) || (request->sto != 0)) {
      sup->refused = {{ NAME }}_START_STOPPED;
    } else {
      sup->refused = {{ name }}_refuses_parameters(sup->parameters, &sup->refused_entry);
    }
  }
}

{% endif %}
/* Whether nothing forbids torque. */
static bool is_free(const {{ name }}_request *request) { return (request->stop == 0) && (request->sto == 0); }

/* The event of a sample: the strongest. Start and acknowledge count when they come, not while they stay. */
static int32_t event_of(const {{ name }}_supervisor *sup, const {{ name }}_request *request, int32_t reaction) {
  int32_t event = EVENT_NONE;
  if (reaction == {{ NAME }}_REACTION_FAULT) {
    event = EVENT_FAULT;
  } else if ((reaction == {{ NAME }}_REACTION_LAND) || (request->land != 0)) {
    event = EVENT_LAND;
  } else if (reaction == {{ NAME }}_REACTION_HOLD) {
    event = EVENT_HOLD;
  } else if (is_done(sup, request)) {
    event = EVENT_DONE;
{% if wiring %}
    if ((sup->state == {{ NAME }}_SENSORS) && (sup->wired != 1)) {
      event = EVENT_WIRE;
    }
{% endif %}
  } else if (is_startable(sup, request) && is_free(request)) {
    event = EVENT_START;
  } else if ((request->acknowledge != 0) && (sup->acknowledged == 0) && is_free(request)) {
    event = EVENT_ACKNOWLEDGE;
  } else {
    /* nothing */
  }
  if ((event == EVENT_LAND) && (sup->state == {{ NAME }}_LANDING) && is_done(sup, request)) {
    event = EVENT_DONE;
  }
  return event;
}

/* The place where a moving reference stops, within the room that is left, and the time that this takes. */
static void stop_output({{ name }}_supervisor *sup, int32_t k, {{ name }}_real p, {{ name }}_real dp) {
  static const {{ name }}_real stopping[OUTPUTS] = { {{ stopping }} }; /* of references, per s^2 */
  const {{ name }}_real speed = size_of(dp);
  const {{ name }}_real ahead = (dp > {{ zero }}) ? (near_touch[k] - p) : (near_touch[k] + p);
  const {{ name }}_real shortest = {{ shortest }} * {{ NAME }}_SAMPLE_TIME;
  const {{ name }}_real least = ({{ three_halves }} * speed) / {{ steepest }}[k];
  {{ name }}_real lasts = ({{ three_halves }} * speed) / stopping[k];
  if (lasts < shortest) {
    lasts = shortest;
  }
  if ((ahead > {{ zero }}) && ((speed * lasts) > ({{ three_halves }} * ahead))) {
    lasts = ({{ three_halves }} * ahead) / speed; /* it needs three quarters of the way that is left */
    lasts = (lasts > least) ? lasts : least; /* with all the acceleration that there is */
    lasts = (lasts > {{ NAME }}_SAMPLE_TIME) ? lasts : {{ NAME }}_SAMPLE_TIME;
  }
  sup->lasts[k] = lasts;
  sup->place[k] = p + ({{ half }} * (dp * lasts));
}

/* Less time for the rate of an output that moves on its way back: it goes on by {{ passing }} of its rate times this time. */
static void return_output({{ name }}_supervisor *sup, int32_t k, {{ name }}_real p, {{ name }}_real dp) {
  const {{ name }}_real speed = size_of(dp);
  const {{ name }}_real ahead = (dp > {{ zero }}) ? (near_touch[k] - p) : (near_touch[k] + p);
  const {{ name }}_real most = {{ half }} * ahead;
  if (({{ passing }} * (speed * sup->stops[k])) > most) {
    const {{ name }}_real least = ({{ fade_rate }} * speed) / {{ steepest }}[k]; /* with all the acceleration that there is */
    const {{ name }}_real room = most / ({{ passing }} * speed);
    sup->stops[k] = (room > least) ? room : least;
    sup->stops[k] = (sup->stops[k] > {{ NAME }}_SAMPLE_TIME) ? sup->stops[k] : {{ NAME }}_SAMPLE_TIME;
  }
}

/* The goal of an output's reference in a state: p, dp, ddp. */
static void goal_of(const {{ name }}_supervisor *sup, const {{ name }}_request *request, int32_t k,
                    {{ name }}_real goal[3]) {
  goal[0] = sup->place[k];
  goal[1] = {{ zero }};
  goal[2] = {{ zero }};
  if (sup->state == {{ NAME }}_OPERATE) {
    goal[0] = request->reference.p[k];
    if (sup->paced[k] == 1) {
      goal[1] = request->reference.dp[k];
      goal[2] = request->reference.ddp[k];
    }
  }
}

/* The time of a way within three quarters of its limits, v = 15/8 d / T, a = 5.8 d / T^2. */
static {{ name }}_real time_of({{ "const %s_supervisor *sup, "|format(name) if tunable }}{{ name }}_real way, int32_t k) {
  {{ name }}_real T = ({{ fade_speed }} * way) / {{ fastest }}[k];
  int32_t doubling;
  if (T < ({{ shortest }} * {{ NAME }}_SAMPLE_TIME)) {
    T = {{ shortest }} * {{ NAME }}_SAMPLE_TIME;
  }
  for (doubling = 0; doubling < 8; doubling++) {
    if (({{ fade_acceleration }} * way) > ({{ steepest }}[k] * (T * T))) {
      T = {{ two }} * T;
    }
  }
  return T;
}

/* Where a state's references go, and the time that this takes; what they differ by at first fades. */
static void begin({{ name }}_supervisor *sup, const {{ name }}_state *s, const {{ name }}_request *request) {
  const int32_t steps = missed_of(request) + 1;
  const {{ name }}_real h = ({{ name }}_real)steps * {{ NAME }}_SAMPLE_TIME;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    const {{ name }}_real ddp = s->reference.ddp[k];
    const {{ name }}_real dp = s->reference.dp[k] + (ddp * h);
    const {{ name }}_real mean = s->reference.dp[k] + ({{ half }} * (ddp * h));
    const {{ name }}_real p = s->reference.p[k] + (mean * h);
    {{ name }}_real goal[3];
    int32_t samples = sup->times.fade;
    switch (sup->state) {
    case {{ NAME }}_LIFT:
      samples = sup->times.lift;
      sup->place[k] = {{ zero }};
      break;
    case {{ NAME }}_LANDING:
      samples = sup->times.landing;
      sup->place[k] = sup->rest[k];
      break;
    default:
      break;
    }
    sup->lasts[k] = ({{ name }}_real)samples * {{ NAME }}_SAMPLE_TIME;
    if (sup->state == {{ NAME }}_OPERATE) {
      const {{ name }}_real soonest = time_of({{ "sup, " if tunable }}size_of(request->reference.p[k] - p), k);
      sup->lasts[k] = (soonest > sup->lasts[k]) ? soonest : sup->lasts[k];
    }
{% if stroke_output >= 0 %}
    if ((k == {{ stroke_output }}) && (sup->state == {{ NAME }}_LIFT)) {
      sup->place[k] = sup->rest[k]; /* the stroke begins in operation */
    }
{% endif %}
    if (sup->state == {{ NAME }}_HOLD) {
      stop_output(sup, k, p, dp);
    }
    sup->stops[k] = sup->lasts[k];
    if (sup->state == {{ NAME }}_LANDING) {
      return_output(sup, k, p, dp);
    }
{% if stroke_output >= 0 %}
    if ((k == {{ stroke_output }}) && (sup->stops[k] < sup->lasts[k])) { /* a stroke that turns is soon back */
      const {{ name }}_real soonest = time_of({{ "sup, " if tunable }}size_of(sup->rest[k] - p), k);
      sup->lasts[k] = (sup->stops[k] > soonest) ? sup->stops[k] : soonest;
    }
{% endif %}
    goal_of(sup, request, k, goal);
    sup->d0[k] = p - goal[0];
    sup->d1[k] = dp - goal[1];
    sup->d2[k] = ddp - goal[2];
  }
}

/* Follow the table of transitions. */
static void change_state({{ name }}_supervisor *sup, {{ name }}_state *s, const {{ name }}_request *request,
                         int32_t event) {
  static const transition transitions[{{ transitions | length }}] = {
{% for row in transitions %}
    { {{ NAME }}_{{ row[0] }}, EVENT_{{ row[1] }}, {{ NAME }}_{{ row[2] }} },
{% endfor %}
  };
  const int32_t from = sup->state;
  int32_t to = from;
  int32_t r;
  for (r = 0; r < {{ transitions | length }}; r++) {
    if ((transitions[r].from == from) && (transitions[r].event == event)) {
      to = transitions[r].to;
    }
  }
  if (to == from) {
    const int32_t passed = (is_flying(from) == 1) ? (1 + missed_of(request)) : 1; /* readings are averaged, not time */
    sup->samples = (sup->samples < {{ longest }}) ? (sup->samples + passed) : sup->samples;
  } else {
    sup->state = to;
    sup->samples = 0;
    sup->steady = 0;
    if (to == {{ NAME }}_OFFSETS) {
{% if currents %}
      int32_t k;
{% endif %}
      forget_sensors(sup);
      sup->monitor = -1;
      sup->reaction = {{ NAME }}_REACTION_NONE;
{% if currents %}
      for (k = 0; k < {{ currents }}; k++) {
        sup->offset[k] = {{ zero }};
      }
{% endif %}
    }
{% if wiring %}
    if (to == {{ NAME }}_WIRING) {
      begin_wiring(sup);
    }
{% endif %}
    if (to == {{ NAME }}_LIFT) {
      int32_t k;
      for (k = 0; k < OUTPUTS; k++) {
        s->reference.p[k] = sup->rest[k];
        sup->since[k] = sup->rest[k];
        s->reference.dp[k] = {{ zero }};
        s->reference.ddp[k] = {{ zero }};
      }
      {{ name }}_start(s);
    }
    if ((is_flying(to) == 1) && (to != {{ NAME }}_SETTLE)) {
      begin(sup, s, request);
    }
  }
}

/* Add (1 - u)^3 (d0 (1 + 3 u + 6 u^2) + d1 T (u + 3 u^2)) with u = t / T: from d0, at the rate d1, to rest at zero. */
static void fade({{ name }}_real t, {{ name }}_real d0, {{ name }}_real d1, {{ name }}_real T,
                 {{ name }}_reference *next, int32_t k) {
  if (t < T) {
    const {{ name }}_real u = t / T;
    const {{ name }}_real v = {{ one }} - u;
    const {{ name }}_real b = d1 * T;
    /* v^3 q with q = d0 + (3 d0 + b) u + (6 d0 + 3 b) u^2 */
    const {{ name }}_real q1 = ({{ three }} * d0) + b;
    const {{ name }}_real q2 = ({{ six }} * d0) + ({{ three }} * b);
    const {{ name }}_real q = d0 + (u * (q1 + (u * q2)));
    const {{ name }}_real dq = q1 + ({{ two }} * (u * q2));
    const {{ name }}_real ddq = {{ two }} * q2;
    const {{ name }}_real slope = (v * dq) - ({{ three }} * q);
    const {{ name }}_real bend = ((v * v) * ddq) + (({{ six }} * q) - ({{ six }} * (v * dq)));
    next->p[k] = next->p[k] + ((v * (v * v)) * q);
    next->dp[k] = next->dp[k] + (((v * v) * slope) / T);
    next->ddp[k] = next->ddp[k] + ((v * bend) / (T * T));
  }
}

/* Add d2 (T^2 / 2) w^2 (1 - w)^3 with w = t / T: an acceleration that fades fast, before a reference brakes. */
static void fade_acceleration({{ name }}_real t, {{ name }}_real d2, {{ name }}_reference *next, int32_t k) {
  const {{ name }}_real T = {{ quick }} * {{ NAME }}_SAMPLE_TIME;
  if (t < T) {
    const {{ name }}_real w = t / T;
    const {{ name }}_real v = {{ one }} - w;
    const {{ name }}_real c = {{ half }} * d2;
    const {{ name }}_real first = ({{ two }} * (w * v)) - ({{ three }} * (w * w));
    const {{ name }}_real second = ({{ two }} * (v * v)) + (({{ six }} * (w * w)) - ({{ twelve }} * (w * v)));
    next->p[k] = next->p[k] + ((c * (T * T)) * ((w * w) * (v * (v * v))));
    next->dp[k] = next->dp[k] + ((c * T) * ((v * v) * first));
    next->ddp[k] = next->ddp[k] + (c * (v * second));
  }
}

/* The speed of the next sample from which an output stops within a way: at the speed v now, braking with a. */
static {{ name }}_real speed_for({{ name }}_real way, {{ name }}_real v, {{ name }}_real a, {{ name }}_real h) {
  const {{ name }}_real middle = {{ half }} * h;
  const {{ name }}_real left = way - (middle * v);
  return (left > {{ zero }}) ? (a * ({{ name }}_root((middle * middle) + (({{ two }} * left) / a)) - middle)) : {{ zero }};
}

/* How far references may go: those of requests by their limit, others as far as the machine, or where it is already. */
static {{ name }}_real end_for(const {{ name }}_supervisor *sup, {{ name }}_real p, int32_t k) {
  const {{ name }}_real goal = size_of(sup->place[k]);
  const {{ name }}_real here = size_of(p);
  {{ name }}_real end = (sup->state == {{ NAME }}_OPERATE) ? {{ farthest }}[k] : near_touch[k];
  if (sup->state != {{ NAME }}_OPERATE) {
    end = (goal > end) ? goal : end;
  }
  return (here > end) ? here : end;
}

/* The next reference of an output. One that the last one leads to within the limits, and from which it can still stop, is
   used as it is. Another one is approached in the shortest time, with three quarters of the acceleration, or with all of
   it where the way ends: then 1 is returned. */
static int32_t steer(const {{ name }}_supervisor *sup, {{ name }}_reference *last, const {{ name }}_reference *next,
                     const {{ name }}_request *request, int32_t k) {
  const int32_t steps = missed_of(request) + 1;
  const {{ name }}_real h = ({{ name }}_real)steps * {{ NAME }}_SAMPLE_TIME;
  const {{ name }}_real p = last->p[k];
  const {{ name }}_real v = last->dp[k];
  const {{ name }}_real rate = next->dp[k];
  const {{ name }}_real a = {{ steepest }}[k];
  const {{ name }}_real end = end_for(sup, p, k);
  const {{ name }}_real room = (rate > {{ zero }}) ? (end - next->p[k]) : (end + next->p[k]);
  const {{ name }}_real off = (next->p[k] - p) - (({{ half }} * h) * (v + rate));
  const int32_t even = is_within(rate - v, {{ exceeding }} * (a * h));
  const int32_t joined = is_within(off, ({{ rounding }} * end) + ({{ half }} * (a * (h * h))));
  const bool stops = (rate * rate) <= ({{ two }} * (a * (({{ exceeding }} * room) + ({{ rounding }} * end))));
  int32_t steered = 0;
  if (((even + joined) == 2) && stops) {
    last->p[k] = next->p[k];
    last->dp[k] = next->dp[k];
    last->ddp[k] = next->ddp[k];
  } else {
    const {{ name }}_real most = {{ gentle }} * a;
    const {{ name }}_real left = most - size_of(next->ddp[k]);
    const {{ name }}_real own = (left > ({{ least_share }} * a)) ? left : ({{ least_share }} * a);
    const {{ name }}_real way = (next->p[k] - (h * rate)) - p;
    const {{ name }}_real sign = (way < {{ zero }}) ? -{{ one }} : {{ one }};
    const {{ name }}_real goal = rate + (sign * speed_for(sign * way, sign * (v - rate), own, h));
    const {{ name }}_real near = between(v - (most * h), goal, v + (most * h));
    const {{ name }}_real slow = between(-{{ fastest }}[k], near, {{ fastest }}[k]);
    const {{ name }}_real now = between(-speed_for(end + p, -v, a, h), slow, speed_for(end - p, v, a, h));
    last->p[k] = between(-end, p + (({{ half }} * h) * (v + now)), end);
    last->dp[k] = now;
    last->ddp[k] = (now - v) / h;
    steered = 1;
  }
  return steered;
}

/* The reference of a sample: the goal, and what is left of the difference at the beginning. */
static void guide({{ name }}_supervisor *sup, {{ name }}_state *s, const {{ name }}_request *request) {
  const {{ name }}_real t = ({{ name }}_real)sup->samples * {{ NAME }}_SAMPLE_TIME;
  {{ name }}_reference next;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    {{ name }}_real goal[3];
    goal_of(sup, request, k, goal);
    next.p[k] = goal[0];
    next.dp[k] = goal[1];
    next.ddp[k] = goal[2];
    if (sup->state != {{ NAME }}_SETTLE) {
      fade(t, sup->d0[k], {{ zero }}, sup->lasts[k], &next, k);
      fade(t, {{ zero }}, sup->d1[k], sup->stops[k], &next, k);
      fade_acceleration(t, sup->d2[k], &next, k);
    }
  }
  sup->steered = 0;
  for (k = 0; k < OUTPUTS; k++) {
    /* what is requested and faded to is finite, of a possible size, and within the limits from here on */
    if ((is_within(next.p[k], range[k]) + is_within(next.dp[k], {{ most_rate }}) + is_within(next.ddp[k], {{ most_rate }})) == 3) {
      if (steer(sup, &s->reference, &next, request, k) == 1) {
        sup->steered++;
      }
    }
  }
}

{% if fallback %}
{% if rejoined %}
/* Where sensors are believed again the filter's places become theirs, and its rates stay: a filter that is off for long
   would take the difference of one sample for a speed. */
static bool rejoin(const {{ name }}_supervisor *sup, {{ name }}_state *s, const {{ name }}_inputs *in,
                   const {{ name }}_real expected[OUTPUTS], const int32_t before[OUTPUTS]) {
  static const {{ name }}_real places[{{ rates }}][OUTPUTS] = { /* of readings */
{{ rejoined }}
  };
  bool again = false;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if ((before[k] > 0) && (sup->unbelieved[k] == 0)) {
      int32_t i;
      again = true;
      for (i = 0; i < {{ rates }}; i++) {
        const {{ name }}_real part = places[i][k] * (in->y[k] - expected[k]);
        s->xi_pred[i] = s->xi_pred[i] + part;
      }
    }
  }
  return again;
}

{% endif %}
{% if places > 1 %}
/* Where the machine is along the stroke, in distances of places that have a gain, from the first to the last. */
static {{ name }}_real place_along(const {{ name }}_real expected[OUTPUTS]) {
  return between({{ zero }}, (expected[{{ stroke_output }}] - ({{ first_place }})) / {{ apart }}, ({{ name }}_real){{ places - 1 }});
}

{% endif %}
{% endif %}
{% if fallback %}
/* The filter without the sensors that are not believed: one of them by a gain for the others, where there is one. */
static int32_t leave_out(const {{ name }}_supervisor *sup, {{ name }}_state *s, const {{ name }}_real expected[OUTPUTS],
                      {{ name }}_inputs *seen) {
  static const int32_t has_gain[OUTPUTS] = { {{ has_gain }} };
  static const {{ name }}_real gain_without[OUTPUTS][{{ places }}][STATES][OUTPUTS] = { /* of the filter, without one sensor each */
{{ gain_rows }}
  };
  int32_t without = -1;
  int32_t number = 0;
  int32_t estimated = 0;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if (sup->unbelieved[k] > 0) {
      seen->y_valid[k] = {{ zero }};
      without = k;
      number++;
    }
  }
  const bool held = (number == 1) && (without == sup->leapt) && (sup->unbelieved[without] <= {{ held }});
  if (held) {
    for (k = 0; k < OUTPUTS; k++) {
      seen->y_valid[k] = {{ zero }}; /* another may lie too */
    }
  } else if ((number == 1) && (has_gain[without] == 1)) {
{% if places > 1 %}
    const {{ name }}_real way = place_along(expected);
    const int32_t place = (way < ({{ name }}_real){{ places - 2 }}) ? (int32_t)way : {{ places - 2 }};
    const {{ name }}_real share = way - ({{ name }}_real)place; /* of the gain of the next place */
{% endif %}
    int32_t i;
    for (i = 0; i < STATES; i++) {
      {{ name }}_real sum = s->xi_pred[i];
      for (k = 0; k < OUTPUTS; k++) {
        if (k != without) {
{% if places > 1 %}
          const {{ name }}_real first = gain_without[without][place][i][k];
          const {{ name }}_real gain = first + (share * (gain_without[without][place + 1][i][k] - first));
{% else %}
          const {{ name }}_real gain = gain_without[without][0][i][k];
{% endif %}
          const {{ name }}_real part = gain * (seen->y[k] - expected[k]);
          sum = sum + part;
        }
      }
      s->xi_pred[i] = sum;
    }
    for (k = 0; k < OUTPUTS; k++) {
      seen->y_valid[k] = {{ zero }}; /* the estimate is made */
    }
    estimated = 1;
  } else {
    /* all others are seen */
  }
  return estimated;
}

{% else %}
/* The filter without the sensors that are not believed. */
static void leave_out(const {{ name }}_supervisor *sup, {{ name }}_inputs *seen) {
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if (sup->unbelieved[k] > 0) {
      seen->y_valid[k] = {{ zero }};
    }
  }
}

{% endif %}
{% if fallback %}
/* What the machine's equations add to the linear prediction: two unstable modes seen by one sensor leave no room. */
static void predict({{ name }}_state *s, const {{ name }}_outputs *out) {
  {{ name }}_real more[STATES];
  int32_t k;
  {{ name }}_correction(out->xi_hat, more);
  for (k = 0; k < STATES; k++) {
    s->xi_pred[k] = s->xi_pred[k] + more[k];
  }
}

{% endif %}
/* Outputs of bridges at zero voltage. */
static void rest_bridges(const {{ name }}_inputs *in, {{ name }}_outputs *out) {
{% if command %}
  static const {{ name }}_real off[{{ command }}] = { {{ off }} };
{% endif %}
  int32_t k;
{% for f in output_fields %}
  for (k = 0; k < {{ f.size }}; k++) {
    out->{{ f.name }}[k] = {{ "off[k]" if f.name == "command" else zero }};
  }
{% endfor %}
  for (k = 0; k < OUTPUTS; k++) {
    if (is_within(in->y[k], {{ most }}) == 1) {
      out->y_used[k] = in->y[k];
    }
  }
}

{% if excited %}
/* Forces beside the law's are for a machine in operation, and within limits of their own. */
static void gate_excitation(const {{ name }}_supervisor *sup, {{ name }}_inputs *seen) {
  static const {{ name }}_real most[{{ forces }}] = { {{ excitation }} };
  bool used = sup->state == {{ NAME }}_OPERATE;
  int32_t k;
  for (k = 0; k < {{ forces }}; k++) {
    used = used && (is_within(seen->excitation[k], most[k]) == 1);
  }
  for (k = 0; k < {{ forces }}; k++) {
    seen->excitation[k] = used ? seen->excitation[k] : {{ zero }};
  }
}

{% endif %}
/* Entry by entry: a compiler may call memcpy for a record. */
static void copy_inputs(const {{ name }}_inputs *in, {{ name }}_inputs *seen) {
  int32_t k;
{% for f in input_fields %}
  for (k = 0; k < {{ f.size }}; k++) {
    seen->{{ f.name }}[k] = in->{{ f.name }}[k];
  }
{% endfor %}
}

void {{ name }}_supervisor_step({{ name }}_supervisor *sup, {{ name }}_state *s, {{ "" if logged else "const " }}{{ name }}_inputs *in,
                       const {{ name }}_request *request, {{ name }}_outputs *out) {
  {{ name }}_inputs seen;
  {{ name }}_real expected[OUTPUTS];
  {{ name }}_real level[{{ monitors | length }}][OUTPUTS];
  int32_t reaction;
{% if rejoined %}
  int32_t before[OUTPUTS];
{% endif %}
  int32_t k;
  copy_inputs(in, &seen);
{% if tunable %}
  if (sup->calibration != NULL) {
    {{ name }}_calibration_take(sup->calibration, s);
  }
  sup->parameters = s->parameters;
{% endif %}
{% if currents %}
  if (sup->state == {{ NAME }}_OFFSETS) {
    if (sup->samples < sup->times.offsets) {
      average_currents(sup, in);
    }
  } else {
    for (k = 0; k < {{ currents }}; k++) {
      seen.i[k] = in->i[k] - sup->offset[k];
    }
  }
{% endif %}
{% if stars %}
  infer_currents(sup, &seen);
{% endif %}
{% if rates %}
  if ((is_flying(sup->state) == 1) && (request->missed > 0)) {
    coast(s, request);
  }
{% endif %}
  expect(sup, s, in, expected);
  look(sup, s, &seen, request, expected, level);
{% if rejoined %}
  for (k = 0; k < OUTPUTS; k++) {
    before[k] = sup->unbelieved[k];
  }
{% endif %}
  reaction = judge(sup, level);
{% if rejoined %}
  if ((is_flying(sup->state) == 1) && rejoin(sup, s, in, expected, before)) {
    expect(sup, s, in, expected);
  }
{% endif %}
  if ((sup->state == {{ NAME }}_SENSORS) && (sup->steady > 0)) {
    average_rest(sup);
  }
{% if wiring %}
  if (sup->state == {{ NAME }}_WIRING) {
    wire(sup, &seen);
  }
{% endif %}
  if (sup->state == {{ NAME }}_SETTLE) {
    count_settled(sup, s, in);
  }
  if (sup->state == {{ NAME }}_LANDING) {
    count_landed(sup, in);
  }
{% if tunable %}
  refuse_start(sup, request);
{% endif %}
  change_state(sup, s, request, event_of(sup, request, reaction));
  remember(sup, request);
  sup->started = request->start;
  sup->acknowledged = request->acknowledge;
{% if wiring %}
  sup->enable = (sup->state == {{ NAME }}_WIRING) ? 1 : is_flying(sup->state);
{% else %}
  sup->enable = is_flying(sup->state);
{% endif %}
  if (is_flying(sup->state) == 1) {
{% if fallback %}
    int32_t estimated;
{% endif %}
    guide(sup, s, request);
{% if excited %}
    gate_excitation(sup, &seen);
{% endif %}
{% if fallback %}
    estimated = leave_out(sup, s, expected, &seen);
{% if logged %}
    copy_inputs(&seen, in);
{% endif %}
    {{ name }}_step(s, &seen, out);
    if (estimated == 1) {
      predict(s, out);
    }
{% else %}
    leave_out(sup, &seen);
{% if logged %}
    copy_inputs(&seen, in);
{% endif %}
    {{ name }}_step(s, &seen, out);
{% endif %}
{% if forces == outputs %}
    for (k = 0; k < OUTPUTS; k++) {
      sup->limited[k] = out->saturated[k];
    }
{% else %}
    for (k = 0; k < OUTPUTS; k++) { /* a force is of no output alone */
      int32_t j;
      sup->limited[k] = {{ zero }};
      for (j = 0; j < {{ forces }}; j++) {
        sup->limited[k] = (out->saturated[j] > sup->limited[k]) ? out->saturated[j] : sup->limited[k];
      }
    }
{% endif %}
{% if currents %}
    sup->commanded = 0;
    for (k = 0; k < {{ coils }}; k++) {
      sup->commanded = (size_of(out->current[k] - sup->current[k]) > {{ moves }}) ? 1 : sup->commanded;
      sup->current[k] = out->current[k];
    }
{% endif %}
  } else {
    rest_bridges(in, out);
{% if wiring %}
    if (sup->state == {{ NAME }}_WIRING) {
      push(sup, out);
    }
{% endif %}
{% if currents %}
    for (k = 0; k < {{ coils }}; k++) {
      sup->current[k] = {{ zero }};
    }
{% endif %}
    for (k = 0; k < OUTPUTS; k++) {
      sup->limited[k] = {{ zero }};
    }
  }
}
