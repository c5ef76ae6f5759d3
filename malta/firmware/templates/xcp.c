/* {{ title }}: see {{ name }}_xcp.h. Written by malta {{ version }}. */
#include "{{ name }}_xcp.h"

#include <stdbool.h>
#include <stddef.h>

#define PACKET {{ NAME }}_XCP_PACKET
#define POSITIVE 0xFFu
#define REFUSED 0xFEu
#define DONE 1 /* bytes of an answer that says no more */
#define ERROR_BUSY 0x33u /* another master */
#define ERROR_UNKNOWN 0x20u
#define ERROR_SYNTAX 0x21u
#define ERROR_RANGE 0x22u
#define ERROR_PROTECTED 0x23u
#define ERROR_PAGE 0x26u
#define ERROR_MODE 0x27u
#define ERROR_SEQUENCE 0x29u
#define ERROR_MEMORY 0x30u
#define BY_UNKNOWN 0
#define REALS {{ reals }} /* of the parameters; whole numbers follow */
#define RECORD_BYTES ((REALS * {{ real_bytes }}) + ({{ counts }} * 4))

static uint32_t word_of(const uint8_t bytes[], int32_t at) {
  return (uint32_t)bytes[at] | ((uint32_t)bytes[at + 1] << 8);
}

static uint32_t long_of(const uint8_t bytes[], int32_t at) {
  return word_of(bytes, at) | (word_of(bytes, at + 2) << 16);
}

static void put_word(uint8_t bytes[], int32_t at, uint32_t value) {
  bytes[at] = (uint8_t)(value & 0xFFu);
  bytes[at + 1] = (uint8_t)((value >> 8) & 0xFFu);
}

static void put_long(uint8_t bytes[], int32_t at, uint32_t value) {
  put_word(bytes, at, value & 0xFFFFu);
  put_word(bytes, at + 2, value >> 16);
}

/* A name that a master asks for. */
static const uint8_t *name_of(int32_t *size) {
  static const uint8_t letters[{{ letters | length }}] = { {{ letters | join(", ") }} };
  *size = {{ letters | length }};
  return letters;
}

/* The bytes of an address, which a master may read; NULL where there are not so many. */
static const uint8_t *bytes_at(const {{ name }}_xcp *x, uint32_t address, int32_t count, int32_t page) {
  const uint8_t *area = NULL;
  const uint32_t offset = address & 0xFFFFu;
  int32_t size = 0;
  switch (address >> 16) {
{% for area in areas %}
  case {{ area.number }}u:
    area = (const uint8_t *){{ area.place }};
    size = (int32_t)sizeof({{ area.type }});
    break;
{% endfor %}
  case {{ parameter_area }}u:
    area = (const uint8_t *)((page == 1) ? &x->calibration->working : &{{ name }}_default_parameters);
    size = (int32_t)sizeof({{ name }}_parameters);
    break;
  case {{ name_area }}u:
    area = name_of(&size);
    break;
  default:
    size = 0;
    break;
  }
  if ((area != NULL) && (count >= 0) && (offset <= (uint32_t)size) && (count <= (size - (int32_t)offset))) {
    area = &area[offset];
  } else {
    area = NULL;
  }
  return area;
}

static int32_t refuse({{ name }}_xcp *x, uint32_t error) {
  x->answer[0] = (uint8_t)REFUSED;
  x->answer[1] = (uint8_t)error;
  return 2;
}

static void forget_lists({{ name }}_xcp *x) {
  int32_t k;
  for (k = 0; k < {{ NAME }}_XCP_LISTS; k++) {
    x->lists[k].runs = 0;
    x->lists[k].count = 0;
    x->lists[k].first = 0;
    x->lists[k].prescaler = 1;
    x->lists[k].passed = 0;
    x->lists[k].selected = 0;
    x->lists[k].stamped = 0;
  }
  x->list_count = 0;
  x->odt_count = 0;
  x->entry_count = 0;
  x->pointer = 0;
  x->pointer_end = 0;
}

void {{ name }}_xcp_init({{ name }}_xcp *x, {{ name }}_calibration *c, const {{ name }}_state *s, const {{ name }}_inputs *in,
                const {{ name }}_outputs *out, {{ name }}_supervisor *sup) {
  {{ name }}_calibration_init(c);
  sup->calibration = c;
  x->calibration = c;
  x->state = s;
  x->in = in;
  x->out = out;
  x->supervisor = sup;
  x->put = 0;
  x->got = 0;
  x->lost = 0;
  x->samples = 0u;
  x->connected = 0;
  x->peer = 0u;
  x->heard = 0u;
  x->mta = 0u;
  x->page = 1;
  x->ecu_page = 0;
  x->sent = 0u;
  x->filled = 0;
  x->garbled = 0;
  forget_lists(x);
}

/* The data of an ODT into the queue; without room it is lost. */
static void read_odt({{ name }}_xcp *x, const {{ name }}_xcp_list *list, int32_t odt) {
  const int32_t next = (x->put + 1) % {{ NAME }}_XCP_QUEUE;
  if (next == x->got) {
    x->lost++;
  } else {
    {{ name }}_xcp_packet *const p = &x->queue[x->put];
    int32_t at = 1;
    int32_t k;
    p->bytes[0] = (uint8_t)odt;
    if ((list->stamped == 1) && (odt == list->first)) {
      put_long(p->bytes, 1, x->samples);
      at = 5;
    }
    for (k = 0; k < x->odts[odt][1]; k++) {
      const int32_t entry = x->odts[odt][0] + k;
      const uint8_t *const from = bytes_at(x, x->addresses[entry], x->sizes[entry], 1);
      int32_t j;
      for (j = 0; (from != NULL) && (j < x->sizes[entry]) && (at < PACKET); j++) {
        p->bytes[at] = from[j];
        at++;
      }
    }
    p->length = at;
    x->put = next;
  }
}

void {{ name }}_xcp_event({{ name }}_xcp *x) {
  int32_t k;
  x->samples++;
  for (k = 0; k < x->list_count; k++) {
    {{ name }}_xcp_list *const list = &x->lists[k];
    if (list->runs == 1) {
      list->passed++;
      if (list->passed >= list->prescaler) {
        int32_t j;
        list->passed = 0;
        for (j = 0; j < list->count; j++) {
          read_odt(x, list, list->first + j);
        }
      }
    }
  }
}

static int32_t connect({{ name }}_xcp *x, uint32_t peer) {
  forget_lists(x);
  x->connected = 1;
  x->peer = peer;
  x->page = 1;
  x->answer[1] = 0x05u; /* calibration, and data acquisition */
  x->answer[2] = 0x80u; /* low bytes first, bytes, optional modes */
  x->answer[3] = (uint8_t)PACKET;
  put_word(x->answer, 4, (uint32_t)PACKET);
  x->answer[6] = 1u;
  x->answer[7] = 1u;
  return 8;
}

static int32_t report_status({{ name }}_xcp *x) {
  int32_t running = 0;
  int32_t k;
  for (k = 0; k < x->list_count; k++) {
    running = (x->lists[k].runs == 1) ? 1 : running;
  }
  x->answer[1] = (running == 1) ? 0x40u : 0u;
  x->answer[2] = 0u; /* nothing is locked */
  x->answer[3] = 0u;
  put_word(x->answer, 4, 0u);
  return 6;
}

/* Bytes from the address that was set on, or from one in the command. */
static int32_t upload({{ name }}_xcp *x, uint32_t address, int32_t count) {
  const uint8_t *const from = bytes_at(x, address, count, x->page);
  int32_t length;
  if ((count < 1) || (count > (PACKET - 1)) || (from == NULL)) {
    length = refuse(x, ERROR_RANGE);
  } else {
    int32_t k;
    for (k = 0; k < count; k++) {
      x->answer[1 + k] = from[k];
    }
    x->mta = address + (uint32_t)count;
    length = 1 + count;
  }
  return length;
}

/* Whether bytes are whole numbers of the record: half of one, or one of another size, is none. */
static bool are_numbers(uint32_t offset, int32_t count) {
  const int32_t reals = REALS * {{ real_bytes }};
  const int32_t at = (int32_t)offset;
  bool whole = (count > 0) && (at < RECORD_BYTES) && (count <= (RECORD_BYTES - at));
  if (at < reals) {
    whole = whole && ((at % {{ real_bytes }}) == 0) && ((count % {{ real_bytes }}) == 0) && (count <= (reals - at));
  } else {
    whole = whole && (((at - reals) % 4) == 0) && ((count % 4) == 0);
  }
  return whole;
}

/* Numbers of the page that no step reads. */
static int32_t download({{ name }}_xcp *x, const uint8_t data[], int32_t count) {
  const uint32_t offset = x->mta & 0xFFFFu;
  int32_t length = DONE;
  if ((x->mta >> 16) != {{ parameter_area }}u) {
    length = refuse(x, ERROR_PROTECTED);
  } else if (x->page != 1) {
    length = refuse(x, ERROR_PROTECTED);
  } else if (!are_numbers(offset, count)) {
    length = refuse(x, ERROR_RANGE);
  } else {
    uint8_t *const to = (uint8_t *)&x->calibration->working;
    int32_t k;
    for (k = 0; k < count; k++) {
      to[offset + (uint32_t)k] = data[k];
    }
    x->mta = x->mta + (uint32_t)count;
  }
  return length;
}

/* What the law has: the page that was written, after its checks, or that of the gain file. */
static int32_t set_page({{ name }}_xcp *x, const uint8_t packet[]) {
  const uint32_t mode = packet[1];
  const int32_t page = (int32_t)packet[3];
  int32_t length = DONE;
  if ((packet[2] != 0u) || (page > 1)) {
    length = refuse(x, ERROR_PAGE);
  } else if ((mode & 0x03u) == 0u) {
    length = refuse(x, ERROR_MODE);
  } else {
    if ((mode & 0x02u) != 0u) {
      x->page = page;
    }
    if ((mode & 0x01u) != 0u) {
      const int32_t reason = {{ name }}_calibration_commit(x->calibration, (page == 1) ? &x->calibration->working : NULL);
      if (reason == {{ NAME }}_PARAMETERS_TAKEN) {
        x->ecu_page = page;
      } else {
        (void)refuse(x, ERROR_RANGE);
        put_word(x->answer, 2, (uint32_t)reason);
        put_word(x->answer, 4, (uint32_t)x->calibration->entry & 0xFFFFu);
        length = 6;
      }
    }
  }
  return length;
}

/* The page that is written becomes that of the gain file again. */
static int32_t copy_page({{ name }}_xcp *x, const uint8_t packet[]) {
  int32_t length = DONE;
  if ((packet[1] != 0u) || (packet[2] != 0u) || (packet[3] != 0u) || (packet[4] != 1u)) {
    length = refuse(x, ERROR_PAGE);
  } else {
    const uint8_t *const from = (const uint8_t *)&{{ name }}_default_parameters;
    uint8_t *const to = (uint8_t *)&x->calibration->working;
    int32_t k;
    for (k = 0; k < (int32_t)sizeof({{ name }}_parameters); k++) {
      to[k] = from[k];
    }
  }
  return length;
}

static int32_t allocate_lists({{ name }}_xcp *x, int32_t count) {
  int32_t length = DONE;
  if ((x->odt_count > 0) || (count < 0)) {
    length = refuse(x, ERROR_SEQUENCE);
  } else if (count > {{ NAME }}_XCP_LISTS) {
    length = refuse(x, ERROR_MEMORY);
  } else {
    x->list_count = count;
  }
  return length;
}

static int32_t allocate_odts({{ name }}_xcp *x, int32_t list, int32_t count) {
  int32_t length = DONE;
  if ((list >= x->list_count) || (x->entry_count > 0)) {
    length = refuse(x, ERROR_RANGE);
  } else if (count > ({{ NAME }}_XCP_ODTS - x->odt_count)) {
    length = refuse(x, ERROR_MEMORY);
  } else {
    int32_t k;
    x->lists[list].first = x->odt_count;
    x->lists[list].count = count;
    for (k = 0; k < count; k++) {
      x->odts[x->odt_count][0] = 0;
      x->odts[x->odt_count][1] = 0;
      x->odt_count++;
    }
  }
  return length;
}

/* Whether a list has such an ODT, and does not run. */
static bool is_free(const {{ name }}_xcp *x, int32_t list, int32_t odt) {
  bool free = (list < x->list_count);
  if (free) {
    free = (odt < x->lists[list].count) && (x->lists[list].runs == 0);
  }
  return free;
}

static int32_t allocate_entries({{ name }}_xcp *x, int32_t list, int32_t odt, int32_t count) {
  int32_t length = DONE;
  if (!is_free(x, list, odt)) {
    length = refuse(x, ERROR_RANGE);
  } else if (count > ({{ NAME }}_XCP_ENTRIES - x->entry_count)) {
    length = refuse(x, ERROR_MEMORY);
  } else {
    int32_t *const own = x->odts[x->lists[list].first + odt];
    int32_t k;
    own[0] = x->entry_count;
    own[1] = count;
    for (k = 0; k < count; k++) {
      x->addresses[x->entry_count] = 0u;
      x->sizes[x->entry_count] = 0;
      x->entry_count++;
    }
  }
  return length;
}

static int32_t point({{ name }}_xcp *x, int32_t list, int32_t odt, int32_t entry) {
  int32_t length = DONE;
  x->pointer_end = 0;
  x->pointer = 0;
  if (!is_free(x, list, odt)) {
    length = refuse(x, ERROR_RANGE);
  } else if (entry >= x->odts[x->lists[list].first + odt][1]) {
    length = refuse(x, ERROR_RANGE);
  } else {
    const int32_t *const own = x->odts[x->lists[list].first + odt];
    x->pointer = own[0] + entry;
    x->pointer_end = own[0] + own[1];
  }
  return length;
}

static int32_t write_entry({{ name }}_xcp *x, const uint8_t packet[]) {
  const int32_t size = (int32_t)packet[2];
  const uint32_t address = long_of(packet, 4);
  int32_t length = DONE;
  if (x->pointer >= x->pointer_end) {
    length = refuse(x, ERROR_SEQUENCE);
  } else if ((size < 1) || (bytes_at(x, address, size, 1) == NULL)) {
    length = refuse(x, ERROR_RANGE);
  } else {
    x->addresses[x->pointer] = address;
    x->sizes[x->pointer] = size;
    x->pointer++;
  }
  return length;
}

static int32_t set_mode({{ name }}_xcp *x, const uint8_t packet[]) {
  const int32_t list = (int32_t)word_of(packet, 2);
  int32_t length = DONE;
  if ((list >= x->list_count) || (word_of(packet, 4) != 0u)) {
    length = refuse(x, ERROR_RANGE);
  } else if ((packet[1] & 0x02u) != 0u) {
    length = refuse(x, ERROR_MODE); /* no stimulation */
  } else {
    x->lists[list].stamped = 0;
    if ((packet[1] & 0x10u) != 0u) {
      x->lists[list].stamped = 1;
    }
    x->lists[list].prescaler = (packet[6] > 0u) ? (int32_t)packet[6] : 1;
  }
  return length;
}

/* 0 stop, 1 start, 2 select. */
static int32_t start_list({{ name }}_xcp *x, uint32_t mode, int32_t list) {
  int32_t length = 2;
  if (list >= x->list_count) {
    length = refuse(x, ERROR_RANGE);
  } else if (mode > 2u) {
    length = refuse(x, ERROR_MODE);
  } else {
    if (mode == 2u) {
      x->lists[list].selected = 1;
    } else {
      x->lists[list].runs = (int32_t)mode;
    }
    x->answer[1] = (uint8_t)x->lists[list].first;
  }
  return length;
}

/* 0 stop all, 1 start those that are selected, 2 stop them. */
static int32_t start_selected({{ name }}_xcp *x, uint32_t mode) {
  int32_t length = DONE;
  if (mode > 2u) {
    length = refuse(x, ERROR_MODE);
  } else {
    int32_t k;
    for (k = 0; k < x->list_count; k++) {
      if ((mode == 0u) || (x->lists[k].selected == 1)) {
        x->lists[k].passed = 0;
        x->lists[k].runs = 0;
        if (mode == 1u) {
          x->lists[k].runs = 1;
        }
      }
      x->lists[k].selected = 0;
    }
  }
  return length;
}

/* Answers that say what there is. */
static int32_t describe({{ name }}_xcp *x, const uint8_t packet[]) {
  int32_t length = BY_UNKNOWN;
  int32_t size = 0;
  switch (packet[0]) {
  case 0xFBu: /* modes of communication */
    put_long(x->answer, 1, 0u);
    put_word(x->answer, 5, 0u);
    x->answer[7] = 0x10u;
    length = 8;
    break;
  case 0xFAu: /* identification */
    (void)name_of(&size);
    x->mta = {{ name_area }}0000u;
    put_word(x->answer, 2, 0u);
    put_long(x->answer, 4, (packet[1] <= 1u) ? (uint32_t)size : 0u);
    x->answer[1] = 0u;
    length = 8;
    break;
  case 0xE9u: /* pages */
    x->answer[1] = 1u;
    x->answer[2] = 0u;
    length = 3;
    break;
  case 0xEAu:
    x->answer[1] = 0u;
    x->answer[2] = 0u;
    x->answer[3] = (uint8_t)((packet[1] == 1u) ? x->ecu_page : x->page);
    length = 4;
    break;
  case 0xDAu: /* lists: allocated, with prescalers and time stamps */
    x->answer[1] = 0x13u;
    put_word(x->answer, 2, {{ lists }}u);
    put_word(x->answer, 4, 1u);
    x->answer[6] = 0u;
    x->answer[7] = 0u;
    length = 8;
    break;
  case 0xD9u:
    x->answer[1] = 1u;
    x->answer[2] = {{ entry_bytes }}u;
    x->answer[3] = 1u;
    x->answer[4] = 0u;
    x->answer[5] = {{ stamp_mode }}u;
    put_word(x->answer, 6, {{ stamp_ticks }}u);
    length = 8;
    break;
  case 0xD7u: /* the only event: a sample of the law */
    (void)name_of(&size);
    x->mta = {{ name_area }}0000u;
    x->answer[1] = 0x04u;
    x->answer[2] = {{ lists }}u;
    x->answer[3] = (uint8_t)size;
    x->answer[4] = {{ cycle }}u;
    x->answer[5] = {{ cycle_unit }}u;
    x->answer[6] = 0u;
    length = (word_of(packet, 2) == 0u) ? 7 : refuse(x, ERROR_RANGE);
    break;
  case 0xDCu: /* clock */
    put_long(x->answer, 0, POSITIVE);
    put_long(x->answer, 4, x->samples);
    length = 8;
    break;
  default:
    length = BY_UNKNOWN;
    break;
  }
  return length;
}

/* Commands of lists. */
static int32_t acquire({{ name }}_xcp *x, const uint8_t packet[]) {
  const int32_t list = (int32_t)word_of(packet, 2);
  int32_t length = BY_UNKNOWN;
  switch (packet[0]) {
  case 0xD6u:
    forget_lists(x);
    length = DONE;
    break;
  case 0xD5u:
    length = allocate_lists(x, list);
    break;
  case 0xD4u:
    length = allocate_odts(x, list, (int32_t)packet[4]);
    break;
  case 0xD3u:
    length = allocate_entries(x, list, (int32_t)packet[4], (int32_t)packet[5]);
    break;
  case 0xE2u:
    length = point(x, list, (int32_t)packet[4], (int32_t)packet[5]);
    break;
  case 0xE1u:
    length = write_entry(x, packet);
    break;
  case 0xE0u:
    length = set_mode(x, packet);
    break;
  case 0xDEu:
    length = start_list(x, packet[1], list);
    break;
  case 0xDDu:
    length = start_selected(x, packet[1]);
    break;
  default:
    length = BY_UNKNOWN;
    break;
  }
  return length;
}

/* Bytes that a command has at least; 0: none is known. */
static int32_t least_bytes(uint32_t command) {
  static const uint8_t known[{{ commands | length }}][2] = { {% for code, size in commands %}{ {{ code }}u, {{ size }}u }{{ ", " if not loop.last }}{% endfor %} };
  int32_t least = 0;
  int32_t k;
  for (k = 0; k < {{ commands | length }}; k++) {
    if (known[k][0] == command) {
      least = (int32_t)known[k][1];
    }
  }
  return least;
}

/* A command that has all its bytes. */
static int32_t obey({{ name }}_xcp *x, const uint8_t packet[], int32_t length) {
  int32_t answered = BY_UNKNOWN;
  switch (packet[0]) {
  case 0xFEu: /* disconnect */
    forget_lists(x);
    x->connected = 0;
    answered = DONE;
    break;
  case 0xFDu:
    answered = report_status(x);
    break;
  case 0xFCu: /* synchronize */
    answered = refuse(x, 0u);
    break;
  case 0xF6u:
    x->mta = long_of(packet, 4);
    answered = DONE;
    break;
  case 0xF5u:
    answered = upload(x, x->mta, (int32_t)packet[1]);
    break;
  case 0xF4u:
    answered = upload(x, long_of(packet, 4), (int32_t)packet[1]);
    break;
  case 0xF0u:
    answered = ((int32_t)packet[1] == (length - 2)) ? download(x, &packet[2], length - 2) : refuse(x, ERROR_SYNTAX);
    break;
  case 0xEBu:
    answered = set_page(x, packet);
    break;
  case 0xE4u:
    answered = copy_page(x, packet);
    break;
  default:
    answered = describe(x, packet);
    if (answered == BY_UNKNOWN) {
      answered = acquire(x, packet);
    }
    break;
  }
  return answered;
}

int32_t {{ name }}_xcp_receive({{ name }}_xcp *x, uint32_t peer, const uint8_t packet[], int32_t length) {
  const uint32_t command = (length > 0) ? packet[0] : 0u;
  const bool other = (x->connected == 1) && (peer != x->peer);
  const bool silent = (x->samples - x->heard) > {{ silent_samples }}u;
  int32_t answered = 0;
  x->answer[0] = (uint8_t)POSITIVE;
  if (other && !(silent && (command == 0xFFu))) {
    answered = refuse(x, ERROR_BUSY);
  } else if (command == 0xFFu) {
    answered = (length >= 2) ? connect(x, peer) : refuse(x, ERROR_SYNTAX);
  } else if (x->connected == 0) {
    answered = 0; /* who is not connected is not answered */
  } else if (least_bytes(command) == 0) {
    answered = refuse(x, ERROR_UNKNOWN);
  } else if (length < least_bytes(command)) {
    answered = refuse(x, ERROR_SYNTAX);
  } else {
    answered = obey(x, packet, length);
  }
  if (!other) {
    x->heard = x->samples;
  }
  return answered;
}

/* A packet with its header, and with a checksum on a serial line. */
static int32_t wrap({{ name }}_xcp *x, const uint8_t packet[], int32_t length, bool serial, uint8_t frame[{{ NAME }}_XCP_FRAME]) {
  int32_t bytes = 4 + length;
  int32_t k;
  put_word(frame, 0, (uint32_t)length);
  put_word(frame, 2, x->sent & 0xFFFFu);
  x->sent++;
  for (k = 0; k < length; k++) {
    frame[4 + k] = packet[k];
  }
  if (serial) {
    uint32_t sum = 0u;
    for (k = 0; k < bytes; k++) {
      sum = sum + frame[k];
    }
    frame[bytes] = (uint8_t)(sum & 0xFFu);
    bytes++;
  }
  return bytes;
}

int32_t {{ name }}_xcp_datagram({{ name }}_xcp *x, uint32_t peer, const uint8_t bytes[], int32_t length,
                       uint8_t frame[{{ NAME }}_XCP_FRAME]) {
  int32_t answered = 0;
  if ((length < 5) || ((int32_t)word_of(bytes, 0) != (length - 4)) || (length > (PACKET + 4))) {
    x->garbled++;
    if (length >= 4) {
      answered = refuse(x, ERROR_SYNTAX);
    }
  } else {
    answered = {{ name }}_xcp_receive(x, peer, &bytes[4], length - 4);
  }
  return (answered > 0) ? wrap(x, x->answer, answered, false, frame) : 0;
}

int32_t {{ name }}_xcp_serial({{ name }}_xcp *x, int32_t byte, uint8_t frame[{{ NAME }}_XCP_FRAME]) {
  int32_t answered = 0;
  if (byte < 0) {
    if (x->filled > 0) {
      x->garbled++; /* cut short */
    }
    x->filled = 0;
  } else {
    int32_t length = 0;
    x->partial[x->filled] = (uint8_t)((uint32_t)byte & 0xFFu);
    x->filled++;
    if (x->filled >= 2) {
      length = (int32_t)word_of(x->partial, 0);
    }
    if ((x->filled >= 2) && ((length < 1) || (length > PACKET))) {
      x->garbled++;
      x->filled = 0;
    } else if ((x->filled >= 2) && (x->filled == (length + 5))) {
      uint32_t sum = 0u;
      int32_t k;
      for (k = 0; k < (length + 4); k++) {
        sum = sum + x->partial[k];
      }
      x->filled = 0;
      if ((sum & 0xFFu) == x->partial[length + 4]) {
        answered = {{ name }}_xcp_receive(x, 0u, &x->partial[4], length);
      } else {
        x->garbled++;
        answered = refuse(x, ERROR_SYNTAX);
      }
    } else {
      /* more is to come */
    }
  }
  return (answered > 0) ? wrap(x, x->answer, answered, true, frame) : 0;
}

int32_t {{ name }}_xcp_transmit({{ name }}_xcp *x, int32_t serial, uint8_t frame[{{ NAME }}_XCP_FRAME]) {
  int32_t bytes = 0;
  if (x->got != x->put) {
    const {{ name }}_xcp_packet *const p = &x->queue[x->got];
    bytes = wrap(x, p->bytes, p->length, serial == 1, frame);
    x->got = (x->got + 1) % {{ NAME }}_XCP_QUEUE;
  }
  return bytes;
}
