/* {{ title }}: the supervisor of the controller in {{ name }}.h. Written by malta {{ version }}.

   A state machine around {{ name }}_step: it starts a machine that rests, watches it in flight, and lands it.

{% for line in state_lines %}
   {{ line }}
{% endfor %}

   References of outputs are continuous with their rates and accelerations at every change of state. Monitors are
   counted at every sample; a row acts when its level is over its threshold for so many samples in a row:

{% for line in monitor_lines %}
   {{ line }}
{% endfor %}

   References go to their requests within the limits, and so that they can still stop before the end of the way. A request
   that is within them is used as it is; of one whose rate is not that of its places, the place alone.

   ignore: the filter goes on without the reading, with a gain for the other sensors where there is one; a reading is
   believed again after some samples near what the filter expects, soon after it was lost or never. hold: the reference stops. land: down to the place where the
   machine rested. fault: bridges at zero voltage until acknowledged.

   {{ name }}_supervisor_init tries the arithmetic of the compiled text, {{ name }}_self_test(). Where that is
   not what is written (`fit` is 0), the machine stays off.

{% if wiring %}
   Before the first lift-off the wiring is tried, with {{ wiring_share }} % of the limits of forces at most; `wired` is then 1,
   or -1 and a fault: `shows` has the output that each reading shows, from 1 on and negative where it is inverted, 0 for
   none, and `gain` how much of it; `coil` what each command drives, from 0 on, `turned` -1 where it is inverted; `reads` the
   current of each sensor, as `shows`; `at` the place of the table of the stroke where the currents are commutated as they
   should be; `doubt` is not -1 where another mistake has the same answers. malta's `wiring_sentences` says it in words.
   Set `wired` to 1 to leave it out.

{% endif %}
   At every sample, in place of {{ name }}_step:
     {{ name }}_supervisor_step(&supervisor, &state, &inputs, &request, &outputs).                                      */
#ifndef {{ NAME }}_SUPERVISOR_H
#define {{ NAME }}_SUPERVISOR_H

#include "{{ name }}.h"

#ifdef __cplusplus
extern "C" {
#endif

/* States. */
{% for key in states %}
#define {{ NAME }}_{{ key }} {{ loop.index0 }}
{% endfor %}

/* Monitors. */
{% for key in monitors %}
#define {{ NAME }}_MONITOR_{{ key }} {{ loop.index0 }}
{% endfor %}

/* Reactions, the stronger the larger. */
{% for key in reactions %}
#define {{ NAME }}_REACTION_{{ key }} {{ loop.index0 }}
{% endfor %}

{% if tunable %}
/* Why a start is refused, beside the reasons of {{ NAME }}_PARAMETERS. */
#define {{ NAME }}_START_ARITHMETIC 10 /* the compiled arithmetic is not that of the text */
#define {{ NAME }}_START_STOPPED 11    /* an emergency stop, or safe torque off */

{% endif %}
#define {{ NAME }}_MONITOR_ROWS {{ rows | length }}

/* A row of the table of monitors. */
typedef struct {
  int32_t monitor;
  {{ name }}_real threshold; /* of the monitor's level */
  int32_t samples;           /* in a row that the level is over it until the row acts */
  int32_t reaction;
  uint32_t states;           /* in which the row counts: a bit for each */
} {{ name }}_monitor;

extern const {{ name }}_monitor {{ name }}_monitors[{{ NAME }}_MONITOR_ROWS];
{% for record in records %}

/* {{ record.meaning }} */
typedef struct {
{% for line in record.lines %}
  {{ line }}
{% endfor %}
} {{ name }}_{{ record.name }};
{% endfor %}

/* A supervisor of a machine that is off, with the times of its design; they may be changed before the start. */
void {{ name }}_supervisor_init({{ name }}_supervisor *sup);

/* For a machine that flies already, at the reference of its controller: operation. rest: where it would rest.
   Without a fit arithmetic it is off. */
void {{ name }}_supervisor_take_over({{ name }}_supervisor *sup, const {{ name }}_real rest[{{ outputs }}]);

/* One sample. Any numbers may be in `in` and in the request's reference, also NaN and infinity.{{ " What the law is given is\n   written into `in`: currents without offsets, and readings that are left out are invalid." if logged }} */
void {{ name }}_supervisor_step({{ name }}_supervisor *sup, {{ name }}_state *s, {{ "" if logged else "const " }}{{ name }}_inputs *in,
                       const {{ name }}_request *request, {{ name }}_outputs *out);

#ifdef __cplusplus
}
#endif
#endif
