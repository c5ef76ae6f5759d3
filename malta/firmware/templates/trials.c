/* Flights of the supervisor with the stand-in, in short times: through all states, then each fault in each state. */
#define WISHES 18
#define TRANSITIONS {{ transitions|length }}
#define STATES_ALL {{ states|length }}
#define SENSORS {{ outputs }}
#define HURRIED 10 /* samples that a long row counts by itself at its beginning and at its end */

typedef struct {
  {{ name }}_supervisor sup;
  {{ name }}_state s;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  stand_in machine;
} flight;

/* What is asked for until a state is reached. */
typedef struct {
  {{ name }}_request request;
  int32_t until;
} wish;

typedef struct {
  int32_t from;
  int32_t reaction; /* that leads to it, or NONE: something else */
  int32_t to;
  int32_t taken;
} passage;

/* What was seen of all that the supervisor has. */
typedef struct {
  flight at[STATES_ALL]; /* a flight at the beginning of each state */
  int32_t known[STATES_ALL];
  passage passages[TRANSITIONS];
  int32_t acted[{{ NAME }}_MONITOR_ROWS];
  int32_t cells; /* rows in states that were tried */
{% if moves_otherwise %}
  int32_t overtaken; /* of these, where another reaction as strong came first */
{% endif %}
  int32_t failed;
  uint32_t total;
} record;

static const {{ name }}_real beyond_range[{{ outputs }}] = { {{ over.range }} };

static void complain(record *all, const char *what, int32_t a, int32_t b) {
  all->failed++;
  (void)printf("supervisor: %s: %ld, %ld\n", what, (long)a, (long)b);
}

/* Remember a transition, and what must hold in every sample: no force where gates are off, currents within limits. */
static void note(record *all, const flight *f, int32_t before) {
  static const {{ name }}_real most[{{ coils }}] = { {{ over.coil }} }; /* A */
  const int32_t now = f->sup.state;
  const bool on = (now >= {{ NAME }}_LIFT) && (now <= {{ NAME }}_LANDING);
  bool listed = now == before;
  int32_t k;
  for (k = 0; k < TRANSITIONS; k++) {
    if ((all->passages[k].from == before) && (all->passages[k].to == now)) {
      all->passages[k].taken++;
      listed = true;
    }
  }
  if (!listed) {
    complain(all, "a transition that is not of the table", before, now);
  }
  if ((f->sup.enable == 1) != on) {
    complain(all, "gates in a state", f->sup.enable, now);
  }
  for (k = 0; k < {{ coils }}; k++) {
    const {{ name }}_real limit = on ? most[k] : {{ zero }};
    if (!((f->out.current[k] <= limit) && (f->out.current[k] >= -limit))) {
      complain(all, "a current in a state", k, now);
    }
  }
  for (k = 0; k < {{ forces }}; k++) {
    if ((!on) && !(f->out.v[k] == {{ zero }})) {
      complain(all, "a force in a state", k, now);
    }
  }
}

/* One sample of a flight. */
static void fly_sample(record *all, flight *f, const {{ name }}_request *request) {
  const int32_t before = f->sup.state;
  int32_t monitor;
  int32_t k;
  {{ name }}_supervisor_step(&f->sup, &f->s, &f->in, request, &f->out);
  all->total = (all->total ^ (uint32_t)f->sup.state) * {{ fnv_factor }}u;
  monitor = f->sup.monitor + 1;
  all->total = (all->total ^ (uint32_t)monitor) * {{ fnv_factor }}u;
{% for f in output_all %}
  all->total = add_all(all->total, f->out.{{ f.name }}, {{ f.size }});
{% endfor %}
  for (k = 0; k < {{ outputs }}; k++) {
    all->total = add_bits(all->total, f->s.reference.p[k]);
  }
  note(all, f, before);
}

static void read_machine(flight *f) {
{% if driven or model is defined %}
  read_stand_in(&f->machine, f->sup.enable, &f->s, &f->out, &f->in);
{% else %}
  read_stand_in(&f->machine, f->sup.enable, &f->s, &f->in);
{% endif %}
}

static void shorten({{ name }}_supervisor *sup) {
{% if wiring %}
  sup->wired = 1; /* the stand-in has none */
{% endif %}
  sup->times.offsets = {{ 20 if driven else 0 }};
  sup->times.check = 20;
  sup->times.lift = 100;
  sup->times.settle = 10;
  sup->times.fade = 100;
  sup->times.landing = 100;
  sup->times.calm = 10;
}

/* Through all states; a flight at the beginning of each is kept. */
static void fly(record *all) {
  static const wish wishes[WISHES] = {
    { { .start = 1, .operate = 1 }, {{ NAME }}_OPERATE }, { { .missed = 3 }, {{ NAME }}_HOLD },
    { { .operate = 1 }, {{ NAME }}_OPERATE },             { { .land = 1 }, {{ NAME }}_OFF },
    { { .operate = 1, .start = 1 }, {{ NAME }}_SETTLE },  { { .land = 1 }, {{ NAME }}_OFF },
    { { .start = 1 }, {{ NAME }}_LIFT },                  { { .stop = 1 }, {{ NAME }}_FAULT },
    { { .acknowledge = 1 }, {{ NAME }}_OFF },             { { .start = 1 }, {{ NAME }}_SENSORS },
    { { .sto = 1 }, {{ NAME }}_FAULT },                   { { .acknowledge = 1 }, {{ NAME }}_OFF },
    { { .start = 1 }, {{ NAME }}_OFFSETS },               { { .land = 1 }, {{ NAME }}_OFF },
    { { .start = 1 }, {{ NAME }}_SENSORS },               { { .land = 1 }, {{ NAME }}_OFF },
    { { .start = 1 }, {{ NAME }}_LIFT },                  { { .land = 1 }, {{ NAME }}_OFF }
  };
  static const {{ name }}_real rest[{{ outputs }}] = { {{ over.rest }} };
  static flight f;
  int32_t k;
  {{ name }}_init(&f.s);
  {{ name }}_supervisor_init(&f.sup);
  shorten(&f.sup);
  f.sup.started = 0;
  for (k = 0; k < {{ outputs }}; k++) {
    f.machine.rest[k] = rest[k];
  }
  for (k = 0; k < WISHES; k++) {
    int32_t samples = 0;
    while ((f.sup.state != wishes[k].until) && (samples < {{ longest_wish }})) {
      samples++;
      read_machine(&f);
      fly_sample(all, &f, &wishes[k].request);
      if (all->known[f.sup.state] == 0) {
        all->at[f.sup.state] = f;
        all->known[f.sup.state] = 1;
      }
    }
    if (f.sup.state != wishes[k].until) {
      complain(all, "a wish ends in another state", k, f.sup.state);
    }
  }
}

/* A machine that moves near its end is taken over, and then asked for a place that is far away, or to land: its reference
   stops, or goes home, within the room that there is. */
static void take_over(record *all) {
  static const {{ name }}_real rest[{{ outputs }}] = { {{ ([zero] * outputs) | join(", ") }} };
  int32_t lands;
  for (lands = 0; lands < 2; lands++) {
    static flight f;
    int32_t n;
    {{ name }}_init(&f.s);
    f.s.reference.p[{{ moved.output }}] = {{ moved.place }};
    f.s.reference.dp[{{ moved.output }}] = {{ moved.speed }};
    {{ name }}_start(&f.s);
    {{ name }}_supervisor_take_over(&f.sup, rest);
    f.sup.times.calm = 10;
    f.sup.times.fade = 10;
    for (n = 0; n < ((lands == 1) ? 200 : 1000); n++) {
      static {{ name }}_request request;
      request.land = lands;
      request.reference.p[{{ moved.output }}] = (n == 0) ? beyond_range[{{ moved.output }}] : -({{ moved.place }});
      read_machine(&f);
      fly_sample(all, &f, &request);
      if (!(f.s.reference.p[{{ moved.output }}] <= {{ moved.end }})) {
        complain(all, "a reference beyond the end, in state and sample", f.sup.state, n);
      }
    }
  }
}

{% if driven %}
/* Faults of currents and of the link; n: samples since the fault began. */
static void disturb_currents(flight *f, const {{ name }}_monitor *row, int32_t n) {
  static {{ name }}_real held[{{ currents }}];
  int32_t k;
  switch (row->monitor) {
  case {{ NAME }}_MONITOR_CURRENT:
    f->in.i[n % {{ currents }}] = {{ over.current }};
    break;
  case {{ NAME }}_MONITOR_OFFSET:
    f->in.i[0] = {{ over.offset }};
    break;
  case {{ NAME }}_MONITOR_CURRENT_LOST:
    for (k = 0; k < {{ currents }}; k++) {
      if ((n % 2) == 0) {
        f->in.i[k] = ({{ name }}_real)NAN;
      } else {
        f->in.i_valid[k] = {{ zero }};
      }
    }
    break;
  case {{ NAME }}_MONITOR_CURRENT_INFERRED:
    if ((n % 2) == 0) {
      f->in.i[0] = ({{ name }}_real)NAN;
    } else {
      f->in.i_valid[{{ currents - 1 }}] = {{ zero }};
    }
    break;
  case {{ NAME }}_MONITOR_CURRENT_SUM:
    f->in.i[0] = f->in.i[0] + ({{ over.factor }} * row->threshold);
    break;
  case {{ NAME }}_MONITOR_CURRENT_FROZEN:
    for (k = 0; k < {{ currents }}; k++) {
      held[k] = (n == 0) ? f->in.i[k] : held[k];
      f->in.i[k] = held[k];
    }
    break;
  case {{ NAME }}_MONITOR_OVERVOLTAGE:
    f->in.link[0] = {{ over.link }};
    break;
  case {{ NAME }}_MONITOR_LINK:
    f->in.link[0] = ((n % 2) == 0) ? {{ half }} * {{ link }} : ({{ name }}_real)NAN;
    break;
  default:
    break;
  }
}

{% endif %}
{% if not tracks_errors %}
/* The filter expects these readings, but of the sensor k this much more, by the smallest change of what it remembers: no
   monitor of another cause acts. Where the filter knows less than is read, the other readings too are off. */
static void let_expect(flight *f, const {{ name }}_real readings[{{ outputs }}], int32_t k, {{ name }}_real more) {
  static const {{ name }}_real shows[{{ outputs }}][{{ estimated }}] = { {{ shows }} };
  static const {{ name }}_real told[{{ estimated }}][{{ outputs }}] = { {{ told }} }; /* states by readings */
  static const {{ name }}_real alone[{{ estimated }}][{{ outputs }}] = { {{ alone }} }; /* by one that shall be right */
  {{ name }}_real off[{{ outputs }}];
  int32_t j;
  int32_t i;
  for (i = 0; i < {{ outputs }}; i++) {
    off[i] = readings[i];
    for (j = 0; j < {{ estimated }}; j++) {
      off[i] = off[i] - (shows[i][j] * f->s.xi_pred[j]);
    }
  }
  for (j = 0; j < {{ estimated }}; j++) {
    for (i = 0; i < {{ outputs }}; i++) {
      f->s.xi_pred[j] = f->s.xi_pred[j] + (told[j][i] * off[i]);
    }
    f->s.xi_pred[j] = f->s.xi_pred[j] + (alone[j][k] * more);
  }
}

/* What the filter expects at a fault: the readings, but of the sensor k where the fault is the filter's. */
static void disturb_expectation(flight *f, int32_t monitor, int32_t k, int32_t n) {
  static const {{ name }}_real shift[{{ outputs }}] = { {{ over.shift }} };
  static const {{ name }}_real astray[{{ outputs }}] = { {{ over.astray }} };
  static const {{ name }}_real lost[{{ outputs }}] = { {{ over.lost }} };
  {{ name }}_real expects[{{ outputs }}];
  {{ name }}_real more = {{ zero }};
  bool agrees = true;
  int32_t j;
  for (j = 0; j < {{ outputs }}; j++) {
    const bool is_read = (f->in.y[j] <= astray[j]) && (f->in.y[j] >= -astray[j]); /* a NaN is not */
    expects[j] = is_read ? f->in.y[j] : f->s.reference.p[j];
  }
  switch (monitor) {
  case {{ NAME }}_MONITOR_INNOVATION: /* by and by: at once the filter would be lost */
    more = shift[k] * ((n < {{ slowly }}) ? (({{ name }}_real)n / {{ slowly_real }}) : {{ one }});
    break;
  case {{ NAME }}_MONITOR_STROKE:
    more = {{ over.factor }} * shift[k];
    break;
  case {{ NAME }}_MONITOR_ASTRAY:
    more = lost[k] - expects[k];
    break;
  case {{ NAME }}_MONITOR_TOUCH:
  case {{ NAME }}_MONITOR_FOLLOWING:
  case {{ NAME }}_MONITOR_UNSETTLED:
  case {{ NAME }}_MONITOR_SATURATION: /* the stand-in answers no force */
  case {{ NAME }}_MONITOR_HELPLESS:
    break;
  default:
    agrees = false;
    break;
  }
  if (agrees) {
    let_expect(f, expects, k, more);
  }
}

{% endif %}
/* Faults of the filter's memory and of the law's sums: what a broken machine or a flipped bit does to them. */
static void disturb_states(flight *f, int32_t monitor{{ ", int32_t k" if tracks_errors }}{{ ", int32_t n" if reached is defined }}) {
{% if tracks_errors %}
{% if over.saturating is defined %}
  static const {{ name }}_real saturating[{{ estimated }}] = { {{ over.saturating }} };
{% endif %}
  if (monitor == {{ NAME }}_MONITOR_ASTRAY) {
    f->s.reference.p[k] = beyond_range[k];
  }
{% endif %}
  if ((monitor == {{ NAME }}_MONITOR_SATURATION) || (monitor == {{ NAME }}_MONITOR_HELPLESS)) {
    int32_t j;
{% if reached is defined %}
    /* by turns: a current that is measured and answers no voltage leads the filter astray before the row acts */
    const {{ name }}_real sum = ((n % 2) == 0) ? {{ over.sum }} : -({{ over.sum }});
{% endif %}
    for (j = 0; j < {{ outputs }}; j++) {
      f->s.e[j] = {{ "sum" if reached is defined else over.sum }};
    }
{% if over.saturating is defined %}
    for (j = 0; j < {{ estimated }}; j++) {
      f->s.xi_pred[j] = saturating[j];
    }
{% endif %}
{% if observed %}
    for (j = {{ estimated - forces }}; j < {{ estimated }}; j++) {
      f->s.xi_pred[j] = {{ over.observed }};
    }
{% endif %}
  }
}

/* Faults of the position sensor k, or of all. */
static void disturb_sensors(flight *f, int32_t monitor, int32_t k, int32_t n) {
  static const {{ name }}_real beyond_touch[{{ outputs }}] = { {{ over.touch }} };
  static const {{ name }}_real beyond_jump[{{ outputs }}] = { {{ over.jump }} };
  static const {{ name }}_real beyond_settled[{{ outputs }}] = { {{ over.settled }} };
  static const {{ name }}_real drift_step[{{ outputs }}] = { {{ over.drift_step }} };
  static {{ name }}_real held[{{ outputs }}];
  const {{ name }}_real drift = ({{ name }}_real)n * drift_step[k];
  int32_t j;
  switch (monitor) {
  case {{ NAME }}_MONITOR_TOUCH:
    f->in.y[k] = (drift < beyond_touch[k]) ? drift : beyond_touch[k]; /* where its reference is, or was left */
    f->s.reference.p[k] = f->in.y[k];
    f->in.y[k] = f->in.y[k] + f->machine.drawn[k];
    break;
  case {{ NAME }}_MONITOR_FOLLOWING:
    f->in.y[k] = f->in.y[k] + drift;
    break;
  case {{ NAME }}_MONITOR_UNSETTLED:
{% if tracks_errors %}
  case {{ NAME }}_MONITOR_INNOVATION:
{% endif %}
    f->in.y[k] = f->in.y[k] + ((drift < beyond_settled[k]) ? drift : beyond_settled[k]);
    break;
  case {{ NAME }}_MONITOR_RANGE:
    f->in.y[k] = beyond_range[k];
    break;
  case {{ NAME }}_MONITOR_RATE:
    f->in.y[k] = f->in.y[k] + beyond_jump[k];
    break;
  case {{ NAME }}_MONITOR_STUCK:
  case {{ NAME }}_MONITOR_STALE:
    for (j = 0; j < {{ outputs }}; j++) {
      held[j] = (n == 0) ? f->in.y[j] : held[j];
      if ((j == k) || (monitor == {{ NAME }}_MONITOR_STALE)) {
        f->in.y[j] = held[j];
      }
    }
    break;
  case {{ NAME }}_MONITOR_NAN:
    f->in.y_valid[k] = {{ zero }};
    break;
  case {{ NAME }}_MONITOR_UNBELIEVED:
  case {{ NAME }}_MONITOR_HELPLESS:
  case {{ NAME }}_MONITOR_UNREADY:
    f->in.y[k] = ({{ name }}_real)NAN;
    break;
  case {{ NAME }}_MONITOR_BLIND:
    for (j = 0; j < {{ outputs }}; j++) {
      f->in.y[j] = ({{ name }}_real)NAN;
    }
    break;
  default:
    break;
  }
}

/* Requests that make a monitor act, or none. */
static void disturb_request({{ name }}_request *request, const {{ name }}_monitor *row, int32_t state, int32_t k) {
  static const {{ name }}_real step[{{ outputs }}] = { {{ over.step }} }; /* within the limits of places */
  switch (row->monitor) {
  case {{ NAME }}_MONITOR_MISSED:
    request->missed = {{ over.missed }};
    if (row->reaction == {{ NAME }}_REACTION_HOLD) {
      request->missed = 3;
    }
    break;
  case {{ NAME }}_MONITOR_OVERRUN:
    request->missed = 1;
    break;
  case {{ NAME }}_MONITOR_STOP:
    request->stop = 1;
    break;
  case {{ NAME }}_MONITOR_STO:
    request->sto = 1;
    break;
  case {{ NAME }}_MONITOR_REFERENCE:
    request->reference.p[k] = (state == {{ NAME }}_OPERATE) ? step[k] : beyond_range[k];
    break;
  default:
    break;
  }
}

static const {{ name }}_monitor no_fault = { -1, {{ zero }}, 0, {{ NAME }}_REACTION_NONE, 0u };

/* One sample with the fault of a row. */
static void fly_with_fault(record *all, flight *f, const {{ name }}_monitor *row, int32_t k, int32_t n) {
  static const {{ name }}_request nothing = { .start = 0 };
  {{ name }}_request request = nothing;
{% if driven %}
  if (row->monitor == {{ NAME }}_MONITOR_CURRENT_ERROR) { /* currents that are not those of the command */
    f->out.current[0] = f->out.current[0] + {{ over.astray_current }};
  }
  if (row->monitor == {{ NAME }}_MONITOR_CURRENT_EXCESS) {
    f->out.current[0] = f->out.current[0] + {{ over.lost_control }};
  }
{% endif %}
  read_machine(f);
{% if driven %}
  disturb_currents(f, row, n);
{% endif %}
  disturb_sensors(f, row->monitor, k, n);
  disturb_states(f, row->monitor{{ ", k" if tracks_errors }}{{ ", n" if reached is defined }});
{% if not tracks_errors %}
  disturb_expectation(f, row->monitor, k, n);
{% endif %}
  disturb_request(&request, row, f->sup.state, k);
  fly_sample(all, f, &request);
}

/* The middle of a long time is left out: counts and times go on shortly before they are over. */
static void hurry({{ name }}_supervisor *sup, int32_t r, int32_t k, int32_t n) {
  static const int32_t same_values[{{ outputs }}] = { {{ stuck }} };
  const {{ name }}_monitor *row = &{{ name }}_monitors[r];
  int32_t j;
  for (j = 0; j < {{ outputs }}; j++) {
    int32_t *count = &sup->count[{{ "r" if outputs == 1 else "(r * %d)"|format(outputs) }} + j];
    if ((*count >= HURRIED) && (*count < (row->samples - HURRIED))) {
      *count = row->samples - HURRIED;
    }
  }
  if ((n == 0) && (row->monitor == {{ NAME }}_MONITOR_OVERRUN)) {
    sup->late = row->threshold; /* the stand-in does not move on over steps that are missed, as the filter does */
  }
  if (n == HURRIED) {
    if ((row->monitor == {{ NAME }}_MONITOR_STUCK) && (same_values[k] > (2 * HURRIED))) {
      sup->repeated[k] = same_values[k] - HURRIED;
    }
    if ((row->monitor == {{ NAME }}_MONITOR_STALE) && ({{ stale }} > (2 * HURRIED))) {
      sup->unchanged = {{ stale }} - HURRIED;
    }
    if ((row->monitor == {{ NAME }}_MONITOR_UNSETTLED) || (row->monitor == {{ NAME }}_MONITOR_UNREADY)) {
      sup->samples = (int32_t)row->threshold - HURRIED;
    }
  }
}

/* The strongest reaction of rows that acted in a sample. */
static int32_t strongest_of(const int32_t before[{{ NAME }}_MONITOR_ROWS], const {{ name }}_supervisor *sup) {
  int32_t strongest = {{ NAME }}_REACTION_NONE;
  int32_t r;
  for (r = 0; r < {{ NAME }}_MONITOR_ROWS; r++) {
    if ((sup->acted[r] > before[r]) && ({{ name }}_monitors[r].reaction > strongest)) {
      strongest = {{ name }}_monitors[r].reaction;
    }
  }
  return strongest;
}

/* The state after a reaction by the table of transitions. */
static int32_t state_after(const record *all, int32_t from, int32_t reaction) {
  int32_t to = from;
  int32_t k;
  for (k = 0; k < TRANSITIONS; k++) {
    if ((all->passages[k].from == from) && (all->passages[k].reaction == reaction) &&
        (reaction != {{ NAME }}_REACTION_NONE)) {
      to = all->passages[k].to;
    }
  }
  return to;
}

/* A landing or a fault, with its cause or without: off in the time that a landing has, and nothing stays. */
static void end_flight(record *all, flight *f, int32_t r, int32_t k, int32_t begin) {
  static const {{ name }}_request acknowledge = { .acknowledge = 1 };
  int32_t n = 0;
  shorten(&f->sup);
  while ((f->sup.state == {{ NAME }}_LANDING) && (n < 120)) {
    n++;
    fly_with_fault(all, f, &{{ name }}_monitors[r], k, begin + n);
  }
  if (f->sup.state == {{ NAME }}_FAULT) {
    read_machine(f);
    f->sup.acknowledged = 0;
    fly_sample(all, f, &acknowledge);
  }
  if (f->sup.state != {{ NAME }}_OFF) {
    complain(all, "not off after a landing or a fault: row and state", r, f->sup.state);
  }
}

/* A sensor that was ignored is believed again when its fault is over. */
static void believe_again(record *all, flight *f, const {{ name }}_monitor *row, int32_t k, int32_t begin) {
  int32_t n;
  for (n = 0; n < 2; n++) {
    fly_with_fault(all, f, row, k, begin + n);
  }
  if (f->sup.unbelieved[k] == 0) {
    complain(all, "a sensor is believed: monitor and sensor", row->monitor, k);
  }
  for (n = 0; (n < {{ longest_disbelief }}) && (f->sup.unbelieved[k] != 0); n++) {
    fly_with_fault(all, f, &no_fault, k, n); /* the more good readings, the more often it was wrong */
  }
  if (f->sup.unbelieved[k] != 0) {
    complain(all, "a sensor is not believed again: monitor and sensor", row->monitor, k);
  }
}

/* The fault of a row in a state: the row acts, and the state after it is that of the table. */
static void try_row(record *all, int32_t r, int32_t from, int32_t k) {
  static flight f;
  const {{ name }}_monitor *row = &{{ name }}_monitors[r];
  int32_t before[{{ NAME }}_MONITOR_ROWS];
{% if moves_otherwise %}
  int32_t first[{{ NAME }}_MONITOR_ROWS];
{% endif %}
  int32_t state = from;
  int32_t n = 0;
  f = all->at[from];
{% if model is defined %}
  f.machine.still = 1;
{% endif %}
  f.sup.times.offsets = 25;
  f.sup.times.check = {{ longest }};
  f.sup.times.lift = {{ longest }};
  f.sup.times.calm = {{ longest }};
  f.sup.times.landing = {{ longest // 2 }};
  all->cells++;
  for (n = 0; n < 2; n++) {
    fly_with_fault(all, &f, &no_fault, k, n); /* nothing counts that made the state */
  }
{% if moves_otherwise %}
  for (n = 0; n < {{ NAME }}_MONITOR_ROWS; n++) {
    first[n] = f.sup.acted[n];
  }
{% endif %}
  n = 0;
  do {
    int32_t j;
    for (j = 0; j < {{ NAME }}_MONITOR_ROWS; j++) {
      before[j] = f.sup.acted[j];
    }
    state = f.sup.state;
    fly_with_fault(all, &f, row, k, n);
    hurry(&f.sup, r, k, n);
    n++;
  } while ((f.sup.acted[r] == before[r]) && (n < {{ longest_trial }}));
{% if moves_otherwise %}
  if ((f.sup.acted[r] == before[r]) && (strongest_of(first, &f.sup) >= row->reaction)) {
    all->overtaken++; /* the stand-in answers no force, as the filter expects of such states */
  } else if (f.sup.acted[r] == before[r]) {
{% else %}
  if (f.sup.acted[r] == before[r]) {
{% endif %}
    complain(all, "a row of the table of monitors does not act, in state", r, from);
    (void)printf("  it ends in state %ld, monitor %ld\n", (long)f.sup.state, (long)f.sup.monitor);
  } else {
    all->acted[r]++;
    const int32_t next = state_after(all, state, strongest_of(before, &f.sup));
{% if only_stroke or reached is defined %}
    if ((f.sup.state != next) && (state != {{ NAME }}_LANDING)) { /* a landing ends without its sensor */
{% else %}
    if (f.sup.state != next) {
{% endif %}
      complain(all, "a row is followed by another state than its table says", r, f.sup.state);
    }
    if ((row->reaction == {{ NAME }}_REACTION_IGNORE) && (f.sup.state == from)) {
      believe_again(all, &f, row, k, n);
    } else if (row->reaction >= {{ NAME }}_REACTION_LAND) {
      end_flight(all, &f, r, k, n);
    } else {
      /* it goes on */
    }
  }
}

/* Every row of the table of monitors, in every state in which it counts. */
static void try_rows(record *all) {
  static const uint32_t sensors[{{ NAME }}_MONITOR_ROWS] = { {{ sensors }} }; /* that can make a row act, a bit each */
  static const uint32_t out_of_reach[{{ NAME }}_MONITOR_ROWS] = { {{ out_of_reach }} }; /* states, a bit each */
  int32_t r;
  for (r = 0; r < {{ NAME }}_MONITOR_ROWS; r++) {
    uint32_t k = 0u;
    uint32_t state;
    for (state = 0u; state < (uint32_t)STATES_ALL; state++) {
      const uint32_t tried = {{ name }}_monitors[r].states & ~out_of_reach[r];
      if (((tried >> state) & 1u) == 1u) {
        do { /* another sensor in each state */
          k++;
          if (k >= (uint32_t)SENSORS) {
            k = 0u;
          }
        } while (((sensors[r] >> k) & 1u) == 0u);
        try_row(all, r, (int32_t)state, (int32_t)k);
      }
    }
  }
}

/* What was reached, after all flights; a failure where something was not. */
static int32_t summarize(record *all) {
  static const char *const monitors[{{ monitors|length }}] = {
{% for key in monitors %}
    "{{ key|lower }}"{{ "," if not loop.last }}
{% endfor %}
  };
  int32_t taken = 0;
  int32_t last = -1;
  int32_t r;
  for (r = 0; r < TRANSITIONS; r++) {
    if (all->passages[r].taken == 0) {
      complain(all, "a transition was not taken", all->passages[r].from, all->passages[r].to);
    } else {
      taken++;
    }
  }
  for (r = 0; r < {{ NAME }}_MONITOR_ROWS; r++) {
{% if never_act %}
    if ((all->acted[r] == 0){% for row in never_act %} && (r != {{ row }}){% endfor %}) { /* of which no fault makes these act */
{% else %}
    if (all->acted[r] == 0) {
{% endif %}
      complain(all, "a row of the table of monitors did not act", r, {{ name }}_monitors[r].monitor);
    }
  }
  (void)printf("supervisor: %ld of %ld transitions; in %ld faults acted:", (long)taken, (long)TRANSITIONS, (long)all->cells);
  for (r = 0; r < {{ NAME }}_MONITOR_ROWS; r++) {
    const int32_t monitor = {{ name }}_monitors[r].monitor;
    if ((all->acted[r] > 0) && (monitor != last)) {
      (void)printf(" %s", monitors[monitor]);
      last = monitor;
    }
  }
  (void)printf("\n");
{% if moves_otherwise %}
  (void)printf("in %ld of them another reaction as strong came first\n", (long)all->overtaken);
{% endif %}
{% for line in unreached %}
  (void)printf("{{ line }}\n");
{% endfor %}
  return all->failed;
}

static int32_t try_supervisor(uint32_t *total) {
  static record all = { .passages = {
{% for row in transitions %}
    { {{ NAME }}_{{ row[0] }}, {{ NAME }}_REACTION_{{ row[1] if row[1] in reactions else "NONE" }}, {{ NAME }}_{{ row[2] }}, 0 },
{% endfor %}
  } };
  int32_t failed;
  all.total = *total;
  fly(&all);
  take_over(&all);
  try_rows(&all);
  failed = summarize(&all);
  *total = all.total;
  return failed;
}
