/* {{ title }}: a ring of its last samples, as the law saw them. Written by malta {{ version }}.

   {{ rows }} samples, the last {{ seconds }} s at least, with all that was read and commanded; {{ memory }} bytes, of the caller. A
   sample is read and commanded in its place in the ring, so that nothing is copied but the reference:

     {{ name }}_init(&state);  {{ name }}_log_init(&log, &state, after);
     at every sample:  now = {{ name }}_log_sample(&log);  read the sensors into now->in;
                       {{ name }}_step(&state, &now->in, &now->out)  or  {{ name }}_supervisor_step(..., &now->in, ..., &now->out);
                       {{ name }}_log_keep(&log, &state, flown, fault)

   `after` samples after a trigger the ring stops. Then, or at any time between two samples, the bytes of `log` are the dump that
   `malta log` reads: write them into a file NAME.dump. The supervisor writes into now->in what the law was given. */
#ifndef {{ NAME }}_LOG_H
#define {{ NAME }}_LOG_H

#include "{{ name }}.h"

#ifdef __cplusplus
extern "C" {
#endif

#define {{ NAME }}_LOG_ROWS {{ rows }}
#define {{ NAME }}_LOG_BLOCK {{ block }} /* samples; the state before the first of each is kept */
#define {{ NAME }}_LOG_BLOCKS {{ blocks }}
#define {{ NAME }}_LOG_STATE {{ remembered }} /* numbers of a state */
#define {{ NAME }}_LOG_TEXT {{ text_bytes }}

/* Why the ring stops. */
{% for cause in causes %}
#define {{ NAME }}_LOG_{{ cause }} {{ loop.index0 }}
{% endfor %}

/* A sample: what was asked for, what was read, and what was commanded. */
typedef struct {
  {{ name }}_reference reference;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  {{ name }}_real flown[1]; /* 1 where the law ran; 0: gates were off */
} {{ name }}_sample;

/* The ring. Members may be read at any time; only `period` is the caller's to write. */
typedef struct {
  char magic[8];
  uint32_t order;   /* of bytes */
  uint32_t version; /* of this record */
  int32_t text_bytes;
{% for member, meaning in members %}
  int32_t {{ member }}; /* {{ meaning }} */
{% endfor %}
  {{ name }}_real threshold;
  char text[{{ NAME }}_LOG_TEXT]; /* names and units of all that follows */
  {{ name }}_real memory[{{ NAME }}_LOG_BLOCKS][{{ NAME }}_LOG_STATE];
  {{ name }}_sample rows[{{ NAME }}_LOG_ROWS + 1]; /* the last one is for samples after the ring has stopped */
} {{ name }}_log;

/* An empty ring that begins with this state. after: samples that follow a trigger, 0 to {{ NAME }}_LOG_ROWS - 1; else as many as half of them. */
void {{ name }}_log_init({{ name }}_log *log, const {{ name }}_state *s, int32_t after);

/* A trigger where a used reading, by its number, is beyond a threshold, either way; 1, or 0 where there is no such output. */
int32_t {{ name }}_log_watch({{ name }}_log *log, int32_t output, {{ name }}_real threshold);

/* Where the coming sample is. */
{{ name }}_sample *{{ name }}_log_sample({{ name }}_log *log);

/* The sample is over. flown: 1 where the law ran, as supervisor.enable; fault: a trigger where it is not 0, as
   supervisor.monitor != -1. */
void {{ name }}_log_keep({{ name }}_log *log, const {{ name }}_state *s, int32_t flown, int32_t fault);

/* A trigger by call. */
void {{ name }}_log_trigger({{ name }}_log *log);

#ifdef __cplusplus
}
#endif
#endif
