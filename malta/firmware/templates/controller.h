/* {{ title }}: the controller of a {{ machine }}, sampled every {{ period }}.

   From the gain file with sha256 {{ sha256 }}, by malta {{ version }}.
   {{ precision_text }}

   C99 without heap, globals, recursion or library functions. A state belongs to its caller; several may run at once, and a
   step neither blocks nor loops but over a table's rows. Integers have 32 bits; truths inside are bool, which C99 has also
   where no type has 8 bits. Compile without contraction and fast mathematics
   (-ffp-contract=off, no -ffast-math): then every processor computes the same bits. What macros show of another
   arithmetic is refused when it is compiled, what they do not show {{ name }}_self_test() finds. Units are SI, an angle is
   in rad.

   At every sample:  read the sensors,  {{ name }}_step(&state, &inputs, &outputs),  write outputs.{{ last_output }}.     */
#ifndef {{ NAME }}_H
#define {{ NAME }}_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

typedef {{ precision }} {{ name }}_real;

#define {{ NAME }}_SAMPLE_TIME {{ sample_time }} /* s */
#define {{ NAME }}_GAINS_SHA256 "{{ sha256 }}"
#define {{ NAME }}_MALTA_VERSION "{{ version }}"
{% for record in records %}

/* {{ record.meaning }} */
typedef struct {
{% for f in record.fields %}
  {{ name }}_real {{ f.name }}[{{ f.size }}]; /* {{ f.meaning }} */
{% for line in f.lines %}
  /*   {{ line }} */
{% endfor %}
{% endfor %}
{% for line in record.more %}
  {{ line }}
{% endfor %}
} {{ name }}_{{ record.name }};
{% endfor %}
{% if tunable %}

/* The parameters of the gain file, in which a state begins. */
extern const {{ name }}_parameters {{ name }}_default_parameters;

/* The checksum that belongs to a record of parameters, to be written into its member `checksum`. */
uint32_t {{ name }}_checksum(const {{ name }}_parameters *p);

/* Why a record is refused. */
#define {{ NAME }}_PARAMETERS_TAKEN 0    /* it is not */
#define {{ NAME }}_PARAMETERS_NONE 1     /* there is none */
#define {{ NAME }}_PARAMETERS_CHECKSUM 2 /* its checksum is another one: it changed in its memory */
#define {{ NAME }}_PARAMETERS_RANGE 3    /* the number `entry` of the record, from 0 on, is out of its range */
{% if factors %}
#define {{ NAME }}_PARAMETERS_FACTOR 4   /* gains are not those of the gain file times a factor for each axis */
{% endif %}
#define {{ NAME }}_PARAMETERS_BUSY 5     /* the one before waits for its sample */

/* Why a record of parameters is refused, and which of its numbers; entry is -1 where it is none.
   Limits and references are at most those of the gain file, monitors at least as strict, and gains as follows.
{% for line in gain_lines %}
   {{ line }}
{% endfor %} */
int32_t {{ name }}_refuses_parameters(const {{ name }}_parameters *p, int32_t *entry);
int32_t {{ name }}_accepts_parameters(const {{ name }}_parameters *p); /* 1 where it is not */

/* Another record, in memory of the caller, from the next step on; 1, or 0 and nothing changes where it is refused.
   Change a copy, and set it between two steps: a step reads the record while it computes. */
int32_t {{ name }}_set_parameters({{ name }}_state *s, const {{ name }}_parameters *p);

/* Parameters that change while the law runs: a tool writes `working`, a commit checks it, and a sample takes it. */
typedef struct {
  {{ name }}_parameters working;
  {{ name }}_parameters pages[2]; /* one in use, and one that is checked */
  volatile int32_t ready;         /* 1: the other page waits for a sample */
  int32_t used;                   /* page in use */
  int32_t reason;                 /* of the last commit */
  int32_t entry;
  int32_t commits;                /* that a sample has taken */
} {{ name }}_calibration;

void {{ name }}_calibration_init({{ name }}_calibration *c);

/* Checks a copy of a record, or of that of the gain file where there is none, beside the law; why it is refused. Its
   checksum is computed here. The next sample of a supervisor with this `calibration` takes it. */
int32_t {{ name }}_calibration_commit({{ name }}_calibration *c, const {{ name }}_parameters *p);

/* At the begin of a sample, without a check: what a commit has checked. */
void {{ name }}_calibration_take({{ name }}_calibration *c, {{ name }}_state *s);
{% endif %}

/* 1 where the compiled arithmetic is that of the text, which no macro shows; 0: compile it again, without
   -funsafe-math-optimizations and what it consists of, to the nearest, with small numbers. To be called once, at the
   start: the supervisor does so. The second is of {{ name }}_parts.c, and part of the first. */
int32_t {{ name }}_self_test(void);
int32_t {{ name }}_parts_self_test(void);

/* A state at rest at a reference of zero that knows nothing of the machine, with the v0(z) of the gain file. */
void {{ name }}_init({{ name }}_state *s);

/* The same state, for a machine that follows the reference of the state at this moment: bumpless. Keeps the table. */
void {{ name }}_start({{ name }}_state *s);

/* One sample. Any numbers may be in `in`, also NaN and infinity; what cannot be true is not used. */
void {{ name }}_step({{ name }}_state *s, const {{ name }}_inputs *in, {{ name }}_outputs *out);

/* The reference from the next step on; 1, or 0 and nothing changes where a number is not finite or beyond its limit:
{% for line in limit_lines %}
   {{ line }}
{% endfor %} */
int32_t {{ name }}_set_reference({{ name }}_state *s, const {{ name }}_reference *r);

/* Another v0(z): forces v0[{{ forces }} k + j] at z[k], in memory of the caller. 1, or 0 and nothing changes where there are
   fewer than 2 or more than {{ most_points }} points, where z does not grow, or where a force is beyond the limits. */
int32_t {{ name }}_set_v0_table({{ name }}_state *s, int32_t points, const {{ name }}_real z[], const {{ name }}_real v0[]);

/* Sums of errors, integrals of current loops and observed disturbances begin at zero again. */
void {{ name }}_reset_integrators({{ name }}_state *s);
{% if stroke %}

/* A stroke from `start` to `end` (m) in `rise` (s, 10 to 90 %); 1, or 0 where it is out of reach or too fast to compute. */
int32_t {{ name }}_start_stroke({{ name }}_stroke *k, int32_t profile, {{ name }}_real start, {{ name }}_real end,
                       {{ name }}_real rise);

/* The reference of a stroke's next sample; 1 while it moves, 0 when it has ended. */
int32_t {{ name }}_follow_stroke({{ name }}_stroke *k, {{ name }}_reference *r);
#define {{ NAME }}_LOGISTIC 0
#define {{ NAME }}_QUINTIC 1
{% endif %}

/* The pieces of a step, usable alone. */
{% for record in piece_records %}
typedef struct {
{% for field, size in record.fields %}
  {{ name }}_real {{ field }}[{{ size }}];
{% endfor %}
} {{ name }}_{{ record.name }};
{% endfor %}

{% for declaration in declarations %}
{{ declaration }};
{% endfor %}

{% if reads %}

/* The table of the currents, bilinear between its nodes: {{ table_values }} values at each (u, v) of `{{ name }}_places`. */
void {{ name }}_read_table(const {{ name }}_real table_at[{{ 2 * reads }}], {{ name }}_real table[{{ reads * table_values }}]);
{% endif %}

#ifdef __cplusplus
}
#endif
#endif
