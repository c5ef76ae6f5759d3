/* {{ title }}: the slave of {{ name }}_xcp.h on a computer with POSIX, with a stand-in in place of the machine: to try a tool before
   the bench. It is the port of a target as well: its loop is the timer's interrupt, the rest runs beside it.

     {{ name }}_xcp_pc                        UDP, {{ address }}:{{ port }}
     {{ name }}_xcp_pc udp ADDRESS PORT
     {{ name }}_xcp_pc serial /dev/ttyUSB0    {{ baud }} baud

   Written by malta {{ version }}. */
#define _DEFAULT_SOURCE
#include "{{ name }}_xcp.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define BATCH_TIME 1 /* ms, in which samples are made up for */
#define IDLE 20      /* of these without a byte: a frame was cut short */

{% include "xcp_bench.c" %}

/* What the timer's interrupt of a target does. */
static void on_timer(void) {
  read_bench();
  {{ name }}_supervisor_step(&supervisor, &state, &in, &request, &out);
  {{ name }}_xcp_event(&xcp);
}

/* A port as a text says it, or the end. */
static int32_t port_of(const char *text) {
  char *end;
  const long port = strtol(text, &end, 10);
  if ((*end != '\0') || (port < 1) || (port > 65535)) {
    fprintf(stderr, "UDP port: found %s, expected 1 to 65535\n", text);
    exit(2);
  }
  return (int32_t)port;
}

static int32_t open_udp(const char *address, int32_t port) {
  struct sockaddr_in own;
  const int32_t s = socket(AF_INET, SOCK_DGRAM, 0);
  memset(&own, 0, sizeof own);
  own.sin_family = AF_INET;
  own.sin_port = htons((uint16_t)port);
  if (inet_pton(AF_INET, address, &own.sin_addr) != 1) {
    fprintf(stderr, "%s: no IPv4 address\n", address);
    exit(2);
  }
  if (bind(s, (const struct sockaddr *)&own, sizeof own) != 0) {
    fprintf(stderr, "UDP port %d at %s: %s; give another one, as: udp %s %d\n", (int)port, address,
            (errno == EADDRINUSE) ? "another program uses it" : strerror(errno), address, (int)port + 1);
    exit(2);
  }
  return s;
}

static int32_t open_serial(const char *path) {
  struct termios line;
  const int32_t s = open(path, O_RDWR | O_NOCTTY);
  if ((s < 0) || (tcgetattr(s, &line) != 0)) {
    fprintf(stderr, "%s: %s; give a serial port that no other program uses\n", path, strerror(errno));
    exit(2);
  }
  cfmakeraw(&line);
  (void)cfsetspeed(&line, B{{ baud }});
  (void)tcsetattr(s, TCSANOW, &line);
  return s;
}

static void serve_udp(int32_t s, struct sockaddr_in *peer) {
  static uint8_t bytes[2048];
  static uint8_t frame[{{ NAME }}_XCP_FRAME];
  struct sockaddr_in from;
  socklen_t size = sizeof from;
  const ssize_t length = recvfrom(s, bytes, sizeof bytes, MSG_DONTWAIT, (struct sockaddr *)&from, &size);
  int32_t answer = 0;
  if (length > 0) {
    const uint32_t who = ntohl(from.sin_addr.s_addr) ^ ((uint32_t)ntohs(from.sin_port) * 2654435761u);
    answer = {{ name }}_xcp_datagram(&xcp, who, bytes, (int32_t)length, frame);
    if ((xcp.connected == 1) && (xcp.peer == who)) {
      *peer = from;
    }
    if (answer > 0) {
      (void)sendto(s, frame, (size_t)answer, 0, (struct sockaddr *)&from, size);
    }
  }
  while ((answer = {{ name }}_xcp_transmit(&xcp, 0, frame)) > 0) {
    (void)sendto(s, frame, (size_t)answer, 0, (struct sockaddr *)peer, sizeof *peer);
  }
}

static void serve_serial(int32_t s) {
  static int32_t idle = 0;
  static uint8_t bytes[256];
  static uint8_t frame[{{ NAME }}_XCP_FRAME];
  struct pollfd one = { s, POLLIN, 0 };
  const ssize_t length = (poll(&one, 1, 0) > 0) ? read(s, bytes, sizeof bytes) : 0;
  int32_t answer;
  ssize_t k;
  idle = (length > 0) ? 0 : (idle + 1);
  if (idle == IDLE) {
    (void){{ name }}_xcp_serial(&xcp, -1, frame);
  }
  for (k = 0; k < length; k++) {
    answer = {{ name }}_xcp_serial(&xcp, bytes[k], frame);
    if (answer > 0) {
      (void)!write(s, frame, (size_t)answer);
    }
  }
  while ((answer = {{ name }}_xcp_transmit(&xcp, 1, frame)) > 0) {
    (void)!write(s, frame, (size_t)answer);
  }
}

int main(int argc, char **argv) {
  const bool serial = (argc == 3) && (strcmp(argv[1], "serial") == 0);
  const bool udp = (argc == 1) || ((argc == 4) && (strcmp(argv[1], "udp") == 0));
  struct sockaddr_in peer;
  struct timespec begin;
  long made = 0;
  int32_t s;
  memset(&peer, 0, sizeof peer);
  if (!serial && !udp) {
    fprintf(stderr, "%s: expected nothing, udp ADDRESS PORT, or serial PORT\n", argv[0]);
    return 2;
  }
  if (serial) {
    s = open_serial(argv[2]);
  } else if (argc == 4) {
    s = open_udp(argv[2], port_of(argv[3]));
  } else {
    s = open_udp({{ NAME }}_XCP_ADDRESS, {{ NAME }}_XCP_PORT);
  }
  {{ name }}_init(&state);
  {{ name }}_supervisor_init(&supervisor);
{% if wiring %}
  supervisor.wired = 1; /* the stand-in has none */
{% endif %}
  {{ name }}_xcp_init(&xcp, &calibration, &state, &in, &out, &supervisor);
  (void)clock_gettime(CLOCK_MONOTONIC, &begin);
  puts("ready");
  (void)fflush(stdout);
  for (;;) {
    const struct timespec wait = { 0, BATCH_TIME * 1000000L };
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    const double t = (double)(now.tv_sec - begin.tv_sec) + (1e-9 * (double)(now.tv_nsec - begin.tv_nsec));
    for (; (double)made * (double){{ NAME }}_SAMPLE_TIME < t; made++) {
      on_timer();
    }
    if (serial) {
      serve_serial(s);
    } else {
      serve_udp(s, &peer);
    }
    (void)nanosleep(&wait, NULL);
  }
}
