/* {{ title }}: processor in the loop. `malta pil` sends recorded readings over a serial line, this program steps the
   controller with them and answers. Link with {{ name }}.c and {{ name }}_parts.c. Written by malta {{ version }}.

   Define {{ NAME }}_PIL_PORT, and write the port's three functions in a file of your own, which the next export leaves
   alone. Without it they are those of a PC: standard input and output.

   A frame is 0xA5 0x5A, kind, number, bytes of what follows (2), these bytes, and the CRC-32 of all from the kind on (4);
   low bytes first, reals as IEEE 754 has them. A request is answered by a frame of kind + 128 and its number:
     1 who are you     -> protocol, bytes of a real, 1 where it ends with commands, self-test, readings (2), answers (2), the
                          sha256 of the gain file in 64 letters
     2 begin, warm     -> nothing; warm 1: the state of a machine that follows the first reference, 0: that of init
     3 step, readings  -> 1, or 0 where the reference is refused; v, then {{ last }}; counts of the timer (4); checksum (4)
   A frame that is garbled is answered by kind 255. A request with the number of the last one is answered again, and
   steps nothing. */
#include "{{ name }}.h"

#include <stdbool.h>
#include <string.h>
{% include "exact.c" %}

#if defined({{ NAME }}_PIL_PORT)
int32_t {{ name }}_pil_get(void);         /* waits for the next byte; -1 ends the program */
void {{ name }}_pil_put(uint32_t byte);   /* sends a byte */
uint32_t {{ name }}_pil_count(void);      /* a timer that counts up, as DWT->CYCCNT; 0 where there is none */
#else
#include <stdio.h>

static int32_t {{ name }}_pil_get(void) {
  const int byte = getchar();
  return (byte == EOF) ? -1 : (int32_t)byte;
}

static void {{ name }}_pil_put(uint32_t byte) {
  (void)putchar((int)byte);
  (void)fflush(stdout);
}

static uint32_t {{ name }}_pil_count(void) { return 0u; }
#endif

#define READINGS {{ readings }}
#define ANSWERS {{ answers }}
#define REAL_BYTES {{ real_bytes }}u
#define MOST {{ readings * real_bytes }}u /* bytes of a request */
#define STEP_BYTES {{ 9 + answers * real_bytes }}u /* of the answer to a step */
#define CRC_START 0xFFFFFFFFu
#define CRC_GOOD 0xDEBB20E3u /* of bytes with their CRC behind them */

{% include "checksum.c" %}

typedef struct {
  uint32_t kind;
  uint32_t number;
  uint32_t length;
  uint_least8_t bytes[MOST];
} pil_frame;

typedef struct {
  {{ name }}_state s;
  {{ name }}_inputs in;
  {{ name }}_outputs out;
  int32_t warm;    /* 1: the next step is the first, of a machine that follows its reference */
  int32_t last;    /* number of the last step, -1 before */
  uint32_t accepted;
  uint32_t counts;
} pil_run;

static uint32_t add_crc(uint32_t sum, uint32_t byte) {
  uint32_t next = sum ^ byte;
  int32_t k;
  for (k = 0; k < 8; k++) {
    next = ((next & 1u) != 0u) ? ((next >> 1) ^ 0xEDB88320u) : (next >> 1);
  }
  return next;
}

/* A byte into the checksum; 0 at the end of the line. */
static int32_t take_byte(uint32_t *sum, uint32_t *byte) {
  const int32_t found = {{ name }}_pil_get();
  int32_t there = 0;
  *byte = 0u;
  if (found >= 0) {
    *byte = (uint32_t)found & 0xFFu;
    *sum = add_crc(*sum, *byte);
    there = 1;
  }
  return there;
}

/* Wait for the two bytes that begin a frame; 0 at the end of the line. */
static int32_t find_frame(void) {
  int32_t last = 0;
  int32_t byte = {{ name }}_pil_get();
  while ((byte >= 0) && !((last == 0xA5) && (byte == 0x5A))) {
    last = byte;
    byte = {{ name }}_pil_get();
  }
  return (byte >= 0) ? 1 : 0;
}

/* The next frame: 1, 0 where it is garbled, -1 at the end of the line. */
static int32_t receive(pil_frame *f) {
  uint32_t sum = CRC_START;
  uint32_t head[4] = { 0u, 0u, 0u, 0u };
  uint32_t byte = 0u;
  uint32_t k;
  int32_t there = find_frame();
  int32_t found = 0;
  for (k = 0u; (there == 1) && (k < 4u); k++) {
    there = take_byte(&sum, &head[k]);
  }
  f->kind = head[0];
  f->number = head[1];
  f->length = head[2] | (head[3] << 8);
  if (f->length <= MOST) {
    for (k = 0u; (there == 1) && (k < (f->length + 4u)); k++) {
      there = take_byte(&sum, &byte);
      if (k < f->length) {
        f->bytes[k] = (uint_least8_t)byte;
      }
    }
    if (sum == CRC_GOOD) {
      found = 1;
    }
  }
  return (there == 1) ? found : -1;
}

static void put_byte(uint32_t *sum, uint32_t byte) {
  *sum = add_crc(*sum, byte & 0xFFu);
  {{ name }}_pil_put(byte & 0xFFu);
}

static void put_word(uint32_t *sum, uint32_t word) {
  put_byte(sum, word);
  put_byte(sum, word >> 8);
  put_byte(sum, word >> 16);
  put_byte(sum, word >> 24);
}

static void put_reals(uint32_t *sum, const {{ name }}_real values[], int32_t count) {
  int32_t k;
  for (k = 0; k < count; k++) {
    {{ word }} bits;
    (void)memcpy(&bits, &values[k], sizeof bits);
    put_word(sum, (uint32_t)(bits & 0xFFFFFFFFu));
{% if precision == "double" %}
    put_word(sum, (uint32_t)(bits >> 32));
{% endif %}
  }
}

static {{ name }}_real real_at(const uint_least8_t bytes[]) {
  {{ word }} bits = 0u;
  {{ name }}_real value;
  uint32_t k;
  for (k = REAL_BYTES; k > 0u; k--) {
    bits = (bits << 8) | bytes[k - 1u];
  }
  (void)memcpy(&value, &bits, sizeof value);
  return value;
}

static uint32_t begin_answer(uint32_t kind, uint32_t number, uint32_t length) {
  uint32_t sum = CRC_START;
  {{ name }}_pil_put(0xA5u);
  {{ name }}_pil_put(0x5Au);
  put_byte(&sum, kind);
  put_byte(&sum, number);
  put_byte(&sum, length);
  put_byte(&sum, length >> 8);
  return sum;
}

static void end_answer(uint32_t sum) {
  uint32_t rest = sum;
  put_word(&rest, ~sum);
}

static void introduce(uint32_t number) {
  static const char sha256[65] = {{ NAME }}_GAINS_SHA256;
  uint32_t sum = begin_answer(129u, number, 72u);
  int32_t k;
  put_byte(&sum, 1u);
  put_byte(&sum, REAL_BYTES);
  put_byte(&sum, {{ "1u" if last == "commands" else "0u" }});
  put_byte(&sum, (uint32_t){{ name }}_self_test());
  put_byte(&sum, READINGS);
  put_byte(&sum, {{ readings // 256 }}u);
  put_byte(&sum, ANSWERS);
  put_byte(&sum, {{ answers // 256 }}u);
  for (k = 0; k < 64; k++) {
    put_byte(&sum, (uint32_t)sha256[k]);
  }
  end_answer(sum);
}

static void step(pil_run *run, const pil_frame *f) {
  {{ name }}_real readings[READINGS];
  {{ name }}_reference r;
  int32_t next = 0;
  int32_t k;
  for (k = 0; k < READINGS; k++) {
    readings[k] = real_at(&f->bytes[(uint32_t)k * REAL_BYTES]);
  }
{% for f in reference_all %}
  take(r.{{ f.name }}, readings, &next, {{ f.size }});
{% endfor %}
{% for f in input_all %}
  take(run->in.{{ f.name }}, readings, &next, {{ f.size }});
{% endfor %}
  run->accepted = (uint32_t){{ name }}_set_reference(&run->s, &r);
  if (run->warm == 1) {
    {{ name }}_start(&run->s);
    run->warm = 0;
  }
  run->counts = {{ name }}_pil_count();
  {{ name }}_step(&run->s, &run->in, &run->out);
  run->counts = {{ name }}_pil_count() - run->counts;
}

static void answer_step(const pil_run *run, uint32_t number) {
  uint32_t total = {{ fnv_start }}u;
  uint32_t sum = begin_answer(131u, number, STEP_BYTES);
{% for f in output_all %}
  total = add_all(total, run->out.{{ f.name }}, {{ f.size }});
{% endfor %}
{% for f in state_all %}
  total = add_all(total, run->s.{{ f.name }}, {{ f.size }});
{% endfor %}
  put_byte(&sum, run->accepted);
  put_reals(&sum, run->out.v, {{ forces }});
  put_reals(&sum, run->out.{{ last_field }}, ANSWERS - {{ forces }});
  put_word(&sum, run->counts);
  put_word(&sum, total);
  end_answer(sum);
}

static void answer(pil_run *run, const pil_frame *f) {
  if ((f->kind == 1u) && (f->length == 0u)) {
    introduce(f->number);
  } else if ((f->kind == 2u) && (f->length == 1u)) {
    {{ name }}_init(&run->s);
    run->warm = (int32_t)f->bytes[0];
    run->last = -1;
    end_answer(begin_answer(130u, f->number, 0u));
  } else if ((f->kind == 3u) && (f->length == MOST)) {
    if (run->last != (int32_t)f->number) {
      step(run, f);
      run->last = (int32_t)f->number;
    }
    answer_step(run, f->number);
  } else {
    end_answer(begin_answer(255u, f->number, 0u));
  }
}

int main(void) {
  static pil_run run;
  static pil_frame request;
  int32_t found;
  {{ name }}_init(&run.s);
  run.last = -1;
  found = receive(&request);
  while (found >= 0) {
    if (found == 1) {
      answer(&run, &request);
    } else {
      end_answer(begin_answer(255u, request.number, 0u));
    }
    found = receive(&request);
  }
  return 0;
}
