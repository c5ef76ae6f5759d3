/* {{ title }}: an XCP 1.1 slave on UDP and on a serial line, for calibration tools. Written by malta {{ version }}.

   The tool writes a copy of the parameters, page 1, which no step reads. SET_CAL_PAGE of the ECU to page 1 checks it whole,
   and the next sample takes it; to page 0, that of the gain file. What is refused changes nothing: FE, 22, the reason of
   {{ NAME }}_PARAMETERS, and the number of the entry (2 bytes from the fifth on). DAQ lists are sampled at every sample of the law.

     at every sample, after the supervisor's step:  {{ name }}_xcp_event(&xcp);
     beside it, as often as you like:               {{ name }}_xcp_datagram or {{ name }}_xcp_serial with what came in, and
                                                    {{ name }}_xcp_transmit until it returns 0

   The two may interrupt each other as an interrupt and a background loop do, the event the background. Addresses are those of
   {{ name }}.a2l, not of memory. A second master is refused (FE 33) while the first one is heard; one that was silent for
   {{ silence }} s is followed by the next that connects, and the law goes on with what was committed. */
#ifndef {{ NAME }}_XCP_H
#define {{ NAME }}_XCP_H

#include "{{ name }}_supervisor.h"

#include <limits.h>

#if defined(CHAR_BIT) && (CHAR_BIT != 8)
#error "XCP needs bytes of 8 bits"
#endif
#if defined(__BYTE_ORDER__) && (__BYTE_ORDER__ == __ORDER_BIG_ENDIAN__)
#error "this slave is for processors that begin with the lowest byte"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define {{ NAME }}_XCP_ADDRESS "{{ address }}" /* defaults of a port: UDP */
#define {{ NAME }}_XCP_PORT {{ port }}
#define {{ NAME }}_XCP_BAUD {{ baud }} /* of a serial line: length and counter of 2 bytes each, packet, sum of all bytes */
#define {{ NAME }}_XCP_PACKET {{ packet }} /* bytes of a packet, commands and data alike */
#define {{ NAME }}_XCP_FRAME {{ packet + 5 }} /* the same with its header and checksum */
#define {{ NAME }}_XCP_LISTS {{ lists }}
#define {{ NAME }}_XCP_ODTS {{ odts }} /* of all lists together */
#define {{ NAME }}_XCP_ENTRIES {{ entries }} /* of all ODTs together */
#define {{ NAME }}_XCP_QUEUE {{ queue }} /* packets of data that wait */

typedef struct {
  uint8_t bytes[{{ NAME }}_XCP_PACKET];
  int32_t length;
} {{ name }}_xcp_packet;

typedef struct {
  int32_t first; /* of its ODTs */
  int32_t count;
  int32_t prescaler;
  int32_t passed;
  int32_t selected;
  int32_t stamped; /* 1: with time stamps */
  volatile int32_t runs;
} {{ name }}_xcp_list;

typedef struct {
  {{ name }}_calibration *calibration;
  const {{ name }}_state *state;
  const {{ name }}_inputs *in;
  const {{ name }}_outputs *out;
  const {{ name }}_supervisor *supervisor;
  {{ name }}_xcp_list lists[{{ NAME }}_XCP_LISTS];
  int32_t list_count;
  int32_t odts[{{ NAME }}_XCP_ODTS][2]; /* first entry, and how many */
  int32_t odt_count;
  uint32_t addresses[{{ NAME }}_XCP_ENTRIES];
  int32_t sizes[{{ NAME }}_XCP_ENTRIES];
  int32_t entry_count;
  int32_t pointer; /* entry that is written next */
  int32_t pointer_end;
  {{ name }}_xcp_packet queue[{{ NAME }}_XCP_QUEUE];
  volatile int32_t put; /* of the queue: by the event */
  volatile int32_t got; /* by the background */
  int32_t lost;         /* packets for which there was no room */
  uint32_t samples;     /* of the law: time stamps */
  int32_t connected;
  uint32_t peer;
  uint32_t heard; /* samples when the master was heard last */
  uint32_t mta;
  int32_t page;     /* that the master sees */
  int32_t ecu_page; /* that the law has */
  uint32_t sent;    /* counter of frames */
  uint8_t answer[{{ NAME }}_XCP_PACKET];
  uint8_t partial[{{ NAME }}_XCP_FRAME]; /* of a serial line */
  int32_t filled;
  int32_t garbled; /* frames that were cut short, too long, or had another checksum */
} {{ name }}_xcp;

/* A slave of these records; the supervisor takes its parameters from the calibration from here on. */
void {{ name }}_xcp_init({{ name }}_xcp *x, {{ name }}_calibration *c, const {{ name }}_state *s, const {{ name }}_inputs *in,
                const {{ name }}_outputs *out, {{ name }}_supervisor *sup);

/* The sample is over: lists that run are read. */
void {{ name }}_xcp_event({{ name }}_xcp *x);

/* A packet of a master, without header; bytes of the answer in x->answer, or 0. peer: whom it is from, any number. */
int32_t {{ name }}_xcp_receive({{ name }}_xcp *x, uint32_t peer, const uint8_t packet[], int32_t length);

/* A datagram of UDP, with its header; bytes of the answer in `frame`, or 0. */
int32_t {{ name }}_xcp_datagram({{ name }}_xcp *x, uint32_t peer, const uint8_t bytes[], int32_t length,
                       uint8_t frame[{{ NAME }}_XCP_FRAME]);

/* A byte of a serial line, or -1 where none came for some milliseconds: what was begun is left. Bytes of the answer, or 0. */
int32_t {{ name }}_xcp_serial({{ name }}_xcp *x, int32_t byte, uint8_t frame[{{ NAME }}_XCP_FRAME]);

/* The next frame of data; its bytes, or 0. serial: 1 with a checksum */
int32_t {{ name }}_xcp_transmit({{ name }}_xcp *x, int32_t serial, uint8_t frame[{{ NAME }}_XCP_FRAME]);

#ifdef __cplusplus
}
#endif
#endif
