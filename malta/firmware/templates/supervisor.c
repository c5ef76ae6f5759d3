/* {{ title }}: see {{ name }}_supervisor.h. Written by malta {{ version }}. */
#include "{{ name }}_supervisor.h"

#include <stdbool.h>
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
{% if not tunable %}
static const {{ name }}_real fastest[OUTPUTS] = { {{ limits.speed }} };      /* of references */
static const {{ name }}_real steepest[OUTPUTS] = { {{ limits.acceleration }} };
{% endif %}
{% set fastest = "sup->parameters->speed" if tunable else "fastest" %}
{% set steepest = "sup->parameters->acceleration" if tunable else "steepest" %}
{% set row_samples = "sup->parameters->samples[r]" if tunable else "row->samples" %}

static {{ name }}_real size_of({{ name }}_real value) { return (value < {{ zero }}) ? -value : value; }

static int32_t is_flying(int32_t state) {
  return ((state >= {{ NAME }}_LIFT) && (state <= {{ NAME }}_LANDING)) ? 1 : 0;
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

/* Steps that were missed before a sample. */
static int32_t missed_of(const {{ name }}_request *request) {
  const int32_t some = (request->missed > 0) ? request->missed : 0;
  return (some < {{ most_missed }}) ? some : {{ most_missed }};
}

static void forget_sensors({{ name }}_supervisor *sup) {
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    sup->unbelieved[k] = 0;
    sup->repeated[k] = 0;
    sup->since[k] = {{ zero }};
    sup->limited[k] = {{ zero }};
    sup->noise[k] = {{ zero }};
  }
  for (k = 0; k < {{ rows | length * outputs }}; k++) {
    sup->count[k] = 0;
  }
  sup->unchanged = 0;
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
  sup->late = {{ zero }};
  sup->samples = 0;
  sup->steady = 0;
{% if tunable %}
  sup->parameters = &{{ name }}_default_parameters;
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
  for (k = 0; k < {{ axes }}; k++) {
    sup->off_mean[k] = {{ zero }};
    sup->beyond_mean[k] = {{ zero }};
  }
{% for _ in stars %}
  sup->still[{{ loop.index0 }}] = 0;
{% endfor %}
  sup->commanded = 0;
{% endif %}
{% if stars %}
  sup->inferred = 0;
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

{% if not tracks_errors %}
{% if root %}
{% include "root.c" %}

{% endif %}
{{ expectation }}
{% endif %}
{% if fallback %}
{{ correction }}
{% endif %}
{% if currents %}
{{ deviation }}
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
      expected[k] = in->y[k];
    }
  }
}

/* A sensor that repeats a reading, as a share of what noise allows; or of the way that its reference has gone since. */
static {{ name }}_real stuck_level({{ name }}_supervisor *sup, {{ name }}_real reference, int32_t k) {
  static const int32_t same_values[OUTPUTS] = { {{ stuck }} }; /* in a row, from which on a sensor is stuck */
  static const {{ name }}_real unmoved[OUTPUTS] = { {{ unmoved }} };
  {{ name }}_real level = ({{ name }}_real)sup->repeated[k] / ({{ name }}_real)same_values[k];
  if (sup->repeated[k] == 0) {
    sup->since[k] = reference;
  }
  if (((sup->state == {{ NAME }}_LIFT) || (sup->state == {{ NAME }}_LANDING)) && (sup->repeated[k] >= {{ repeats }})) {
    const {{ name }}_real gone = size_of(reference - sup->since[k]) / unmoved[k];
    level = (gone > level) ? gone : level;
  }
  return level;
}

/* Levels of the monitors of each position sensor. */
static void look_at_sensor({{ name }}_supervisor *sup, const {{ name }}_inputs *in, int32_t missed, int32_t k,
                           {{ name }}_real expected, {{ name }}_real reference,
                           {{ name }}_real level[{{ monitors | length }}][OUTPUTS]) {
  static const {{ name }}_real jump[OUTPUTS] = { {{ jump }} }; /* from sample to sample */
  static const {{ name }}_real sigma[OUTPUTS] = { {{ sigma }} }; /* of a reading */
  static const {{ name }}_real drift[OUTPUTS] = { {{ drift }} }; /* of what the filter expects alone, per sample^2 */
  const {{ name }}_real y = in->y[k];
  const int32_t is_number = is_within(y, {{ most }});
  if ((is_number == 1) && (in->y_valid[k] > {{ half }})) { /* a NaN is no yes */
    const {{ name }}_real moved = size_of(y - sup->last[k]);
    const {{ name }}_real age = ({{ name }}_real)sup->unbelieved[k];
    const {{ name }}_real away = size_of(y - expected);
    const {{ name }}_real grown = (age * age) * drift[k];
    const {{ name }}_real counted = (moved < range[k]) ? moved : range[k];
    {{ name }}_real near_expected;
    {{ name }}_real more;
    sup->noise[k] = sup->noise[k] + ({{ memory }} * (counted - sup->noise[k]));
    more = sup->noise[k] / ({{ mean_jump }} * sigma[k]); /* readings may be noisier than they are said to be */
    more = (more > {{ one }}) ? more : {{ one }};
    near_expected = ({{ believed }} * (sigma[k] * more)) + grown;
    sup->repeated[k] = (y == sup->last[k]) ? one_more(sup->repeated[k]) : 0;
    level[{{ NAME }}_MONITOR_RANGE][k] = size_of(y) / range[k];
    level[{{ NAME }}_MONITOR_STUCK][k] = stuck_level(sup, reference, k);
    if (sup->unbelieved[k] == 0) {
      const int32_t steps = missed + 1;
      level[{{ NAME }}_MONITOR_TOUCH][k] = size_of(y) / near_touch[k];
      const {{ name }}_real wider = {{ jump_deviations }} * (sigma[k] * (more - {{ one }}));
      level[{{ NAME }}_MONITOR_RATE][k] = moved / ((jump[k] + wider) * ({{ name }}_real)steps);
      level[{{ NAME }}_MONITOR_INNOVATION][k] = away / (sigma[k] * more);
    } else if (away > near_expected) {
      level[{{ NAME }}_MONITOR_UNBELIEVED][k] = {{ one }};
    } else {
      /* believed again, unless a monitor objects */
    }
    sup->last[k] = y;
  } else {
    level[{{ NAME }}_MONITOR_NAN][k] = {{ one }};
    sup->repeated[k] = 0;
    sup->since[k] = reference;
  }
}

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
  static const {{ name }}_real most[OUTPUTS] = { {{ limits.position }} };
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

/* The last reference that was requested in numbers of possible size: what the next one steps from. */
static void remember({{ name }}_supervisor *sup, const {{ name }}_reference *r) {
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    if ((is_within(r->p[k], range[k]) == 1) && (is_within(r->dp[k], {{ most_rate }}) == 1)) {
      sup->asked[k] = r->p[k];
      sup->asked_rate[k] = r->dp[k];
      sup->followed = 1;
    }
  }
}
{% if stars %}

static const int32_t stars[{{ stars | length }}][{{ stars[0] | length }}] = { {% for star in stars %}{ {{ star | join(", ") }} }{{ ", " if not loop.last }}{% endfor %} };

/* A current without a reading is known by the others of its star, which add up to zero with it. */
static void infer_currents({{ name }}_supervisor *sup, {{ name }}_inputs *seen) {
  int32_t s;
  sup->inferred = 0;
  for (s = 0; s < {{ stars | length }}; s++) {
    {{ name }}_real sum = {{ zero }};
    int32_t lost = 0;
    int32_t which = 0;
    int32_t j;
    for (j = 0; j < {{ stars[0] | length }}; j++) {
      const int32_t k = stars[s][j];
      if ((is_within(seen->i[k], {{ most }}) == 1) && (seen->i_valid[k] > {{ half }})) {
        sum = sum + seen->i[k];
      } else {
        lost++;
        which = k;
      }
    }
    if (lost == 1) {
      seen->i[which] = -sum;
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
    if ((is_within(in->i[k], {{ most }}) == 0) || !(in->i_valid[k] > {{ half }})) {
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
      sup->off_mean[k] = sup->off_mean[k] + ({{ mean_share }} * (now - sup->off_mean[k]));
      sup->beyond_mean[k] = sup->beyond_mean[k] + ({{ mean_share }} * (more - sup->beyond_mean[k]));
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
  level[{{ NAME }}_MONITOR_MISSED][0] = ({{ name }}_real)missed;
  sup->overruns = (missed > 0) ? one_more(sup->overruns) : sup->overruns;
  sup->late = sup->late + ({{ memory }} * (((missed > 0) ? {{ one }} : {{ zero }}) - sup->late));
  level[{{ NAME }}_MONITOR_OVERRUN][0] = sup->late;
  level[{{ NAME }}_MONITOR_STOP][0] = (request->stop != 0) ? {{ one }} : {{ zero }};
  level[{{ NAME }}_MONITOR_STO][0] = (request->sto != 0) ? {{ one }} : {{ zero }};
  level[{{ NAME }}_MONITOR_REFERENCE][0] = (is_reference(sup, request) == 1) ? {{ zero }} : {{ one }};
  level[{{ NAME }}_MONITOR_UNSETTLED][0] = ({{ name }}_real)sup->samples;
  level[{{ NAME }}_MONITOR_UNREADY][0] = ({{ name }}_real)sup->samples;
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
/* Average the readings of a machine at rest: the place where it lands again. */
static void average_rest({{ name }}_supervisor *sup) {
  const int32_t number = (sup->steady > 0) ? sup->steady : 1;
  int32_t k;
  for (k = 0; k < OUTPUTS; k++) {
    const {{ name }}_real more = (sup->last[k] - sup->rest[k]) / ({{ name }}_real)number;
    sup->rest[k] = sup->rest[k] + more;
  }
}

/* Whether a reading is as near to a place as that of a machine that has settled. */
static int32_t is_near({{ name }}_real y, {{ name }}_real place, int32_t k) {
  static const {{ name }}_real settled[OUTPUTS] = { {{ settled }} };
  return is_within(y - place, settled[k]);
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
      there{{ " = (k != %d) ? 1 : there"|format(stroke_output) if stroke_output >= 0 else " = 1" }};
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
  bool rests = true;
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
    goal[1] = request->reference.dp[k];
    goal[2] = request->reference.ddp[k];
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
    const int32_t passed = 1 + missed_of(request);
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
  for (k = 0; k < OUTPUTS; k++) {
    /* a fade may pass a limit of requests, but no reading's range; its numbers are finite as those that it joins are */
    if ((is_within(next.p[k], range[k]) + is_within(next.dp[k], {{ most_rate }}) + is_within(next.ddp[k], {{ most_rate }})) == 3) {
      s->reference.p[k] = next.p[k];
      s->reference.dp[k] = next.dp[k];
      s->reference.ddp[k] = next.ddp[k];
    }
  }
}

{% if fallback %}
/* The nearest place along the stroke for which there is a gain. */
static int32_t place_of(const {{ name }}_real expected[OUTPUTS]) {
{% if places > 1 %}
  const {{ name }}_real along = ((expected[{{ stroke_output }}] - ({{ first_place }})) / {{ apart }}) + {{ half }};
  const {{ name }}_real most = ({{ name }}_real){{ places - 1 }};
  int32_t place = 0;
  if (along > most) {
    place = {{ places - 1 }};
  } else if (along > {{ zero }}) {
    place = (int32_t)along;
  } else {
    /* the first */
  }
  return place;
{% else %}
  (void)expected;
  return 0;
{% endif %}
}

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
  if ((number == 1) && (has_gain[without] == 1)) {
    const int32_t place = place_of(expected);
    int32_t i;
    for (i = 0; i < STATES; i++) {
      {{ name }}_real sum = s->xi_pred[i];
      for (k = 0; k < OUTPUTS; k++) {
        if (k != without) {
          const {{ name }}_real part = gain_without[without][place][i][k] * (seen->y[k] - expected[k]);
          sum = sum + part;
        }
      }
      s->xi_pred[i] = sum;
    }
    for (k = 0; k < OUTPUTS; k++) {
      seen->y_valid[k] = {{ zero }}; /* the estimate is made */
    }
    estimated = 1;
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
  int32_t k;
  copy_inputs(in, &seen);
{% if tunable %}
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
  expect(sup, s, in, expected);
  look(sup, s, &seen, request, expected, level);
  reaction = judge(sup, level);
  if ((sup->state == {{ NAME }}_SENSORS) && (sup->steady > 0)) {
    average_rest(sup);
  }
  if (sup->state == {{ NAME }}_SETTLE) {
    count_settled(sup, s, in);
  }
  if (sup->state == {{ NAME }}_LANDING) {
    count_landed(sup, in);
  }
  change_state(sup, s, request, event_of(sup, request, reaction));
  remember(sup, &request->reference);
  sup->started = request->start;
  sup->acknowledged = request->acknowledge;
  sup->enable = is_flying(sup->state);
  if (is_flying(sup->state) == 1) {
{% if fallback %}
    int32_t estimated;
{% endif %}
    guide(sup, s, request);
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
