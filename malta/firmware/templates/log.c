/* {{ title }}: see {{ name }}_log.h. Written by malta {{ version }}. */
#include "{{ name }}_log.h"

#include <stdbool.h>

/* What the law remembers before the first sample of a block: a replay begins there. */
static void remember({{ name }}_log *log, const {{ name }}_state *s, int32_t block) {
  {{ name }}_real *const to = log->memory[block];
{% for f, at in placed_state %}
{% for k in range(f.size) %}
  to[{{ at + k }}] = s->{{ f.name }}[{{ k }}];
{% endfor %}
{% endfor %}
}

void {{ name }}_log_init({{ name }}_log *log, const {{ name }}_state *s, int32_t after) {
  static const char magic[8] = { {{ magic }} };
  static const char *const text[{{ text|length }}] = {
{% for line in text %}
    "{{ line }}\n"{{ "," if not loop.last }}
{% endfor %}
  };
  int32_t k;
  int32_t filled = 0;
  for (k = 0; k < 8; k++) {
    log->magic[k] = magic[k];
  }
  for (k = 0; k < {{ text|length }}; k++) {
    const char *const line = text[k];
    int32_t j = 0;
    while ((line[j] != '\0') && (filled < {{ NAME }}_LOG_TEXT)) {
      log->text[filled] = line[j];
      filled++;
      j++;
    }
  }
  for (k = filled; k < {{ NAME }}_LOG_TEXT; k++) {
    log->text[k] = '\0';
  }
  log->order = 0x01020304u;
  log->version = {{ log_version }}u;
  log->text_bytes = {{ NAME }}_LOG_TEXT;
  log->period = 0;
  log->watched = -1;
  log->next = 0;
  log->wrapped = 0;
  log->in_block = 0;
  log->cause = {{ NAME }}_LOG_RUNS;
  log->triggered = -1;
  log->left = ((after >= 0) && (after < {{ NAME }}_LOG_ROWS)) ? after : ({{ NAME }}_LOG_ROWS / 2);
  log->stopped = 0;
  log->threshold = {{ zero }};
  remember(log, s, 0);
}

int32_t {{ name }}_log_watch({{ name }}_log *log, int32_t output, {{ name }}_real threshold) {
  const bool known = (output >= 0) && (output < {{ outputs }});
  if (known) {
    log->threshold = threshold;
    log->watched = output;
  }
  return known ? 1 : 0;
}

{{ name }}_sample *{{ name }}_log_sample({{ name }}_log *log) {
  return &log->rows[(log->stopped == 1) ? {{ NAME }}_LOG_ROWS : log->next];
}

/* A trigger at the sample that comes next; the first one counts. */
static void stop_after({{ name }}_log *log, int32_t cause) {
  if (log->cause == {{ NAME }}_LOG_RUNS) {
    log->cause = cause;
    log->triggered = log->next;
  }
}

void {{ name }}_log_trigger({{ name }}_log *log) {
  stop_after(log, {{ NAME }}_LOG_CALL);
}

/* Whether a used reading is beyond its threshold. */
static bool is_beyond(const {{ name }}_log *log, const {{ name }}_outputs *out) {
  bool beyond = false;
  if (log->watched >= 0) {
    const {{ name }}_real level = out->y_used[log->watched];
    beyond = (level > log->threshold) || (level < -log->threshold);
  }
  return beyond;
}

/* A sample that follows a trigger. */
static void count_down({{ name }}_log *log) {
  if (log->left == 0) {
    log->stopped = 1;
  }
  log->left--;
}

/* The next block; the state before its first sample is kept. */
static void begin_block({{ name }}_log *log, const {{ name }}_state *s) {
  log->in_block = 0;
  if (log->next == {{ NAME }}_LOG_ROWS) {
    log->next = 0;
    log->wrapped = 1;
  }
  if (log->stopped == 0) {
    remember(log, s, log->next / {{ NAME }}_LOG_BLOCK);
  }
}

/* Entry by entry: a compiler may call memcpy for a record. */
static void copy_reference(const {{ name }}_reference *from, {{ name }}_reference *to) {
{% for f in reference %}
{% for k in range(f.size) %}
  to->{{ f.name }}[{{ k }}] = from->{{ f.name }}[{{ k }}];
{% endfor %}
{% endfor %}
}

void {{ name }}_log_keep({{ name }}_log *log, const {{ name }}_state *s, int32_t flown, int32_t fault) {
  if (log->stopped == 0) {
    {{ name }}_sample *const now = &log->rows[log->next];
    copy_reference(&s->reference, &now->reference);
    now->flown[0] = ({{ name }}_real)flown;
    if (fault != 0) {
      stop_after(log, {{ NAME }}_LOG_FAULT);
    } else if (is_beyond(log, &now->out)) {
      stop_after(log, {{ NAME }}_LOG_THRESHOLD);
    } else {
      /* it goes on */
    }
    log->next++;
    log->in_block++;
    if (log->cause != {{ NAME }}_LOG_RUNS) {
      count_down(log);
    }
    if (log->in_block == {{ NAME }}_LOG_BLOCK) {
      begin_block(log, s);
    }
  }
}
