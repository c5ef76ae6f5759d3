/* Numbers of a table of text, lines of cells between separators, as Python reads them: to the last bit. */
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Each of them exact; a quotient of two numbers that are exact is rounded once. */
static const double tens[] = {1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                              1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22};
#define MOST 22
#define LONGEST 64 /* characters of a number */

/* m 10^e where that is certain to be rounded correctly; NAN where it is not. */
static double exactly(uint64_t m, long e) {
  if (m == 0) return 0.0;
  if (e < -MOST || e > MOST || FLT_EVAL_METHOD != 0) return NAN;
  if (m <= (uint64_t)1 << 53) return e < 0 ? (double)m / tens[-e] : (double)m * tens[e];
#if defined(__x86_64__) && LDBL_MANT_DIG == 64
  /* Rounded to 64 binary digits, and then to 53: wrong only where the first result is half between two doubles. */
  long double q = e < 0 ? (long double)m / tens[-e] : (long double)m * tens[e];
  uint64_t digits;
  memcpy(&digits, &q, sizeof digits);
  if ((digits & 0x7ff) != 0x400) return (double)q;
#endif
  return NAN;
}

/* What stands where a reading is missing. */
static const char *const missing[] = {"nan", "na", "-", "--", "n/a", "#n/a", "null", "none"};

static int is_missing(const char *s, const char *end) {
  if (s == end) return 1;
  if ((*s >= '0' && *s <= '9') || end - s > 4) return 0;
  for (size_t k = 0; k < sizeof missing / sizeof *missing; ++k) {
    const size_t length = strlen(missing[k]);
    size_t same = 0;
    while (same < length && s + same < end && (s[same] | 32) == (missing[k][same] | 32)) ++same;
    if (same == length && s + length == end) return 1;
  }
  return 0;
}

/* The number in [s, end); 0: it is none that is read here. */
static int number(const char *s, const char *end, char decimal, double *out) {
  while (s < end && (*s == ' ' || *s == '\t')) ++s;
  while (s < end && (end[-1] == ' ' || end[-1] == '\t' || end[-1] == '\r')) --end;
  if (end - s > 1 && *s == '"' && end[-1] == '"') ++s, --end;
  *out = NAN;
  if (is_missing(s, end)) return 1;
  const char *begin = s;
  int negative = *s == '-', digits = 0, seen = 0;
  uint64_t m = 0;
  long e = 0, point = -1;
  if (*s == '-' || *s == '+') ++s;
  for (; s < end && ((*s >= '0' && *s <= '9') || (*s == decimal && point < 0)); ++s) {
    if (*s == decimal) {
      point = 0;
      continue;
    }
    ++seen;
    if (point >= 0) ++point;
    m = 10 * m + (uint64_t)(*s - '0');
    if (m) ++digits;
  }
  if (!seen) return 0;
  if (s < end && (*s | 32) == 'e') {
    const int down = ++s < end && *s == '-';
    if (s < end && (*s == '-' || *s == '+')) ++s;
    if (s == end) return 0;
    for (; s < end && *s >= '0' && *s <= '9' && e < 10000; ++s) e = 10 * e + (*s - '0');
    if (down) e = -e;
  }
  if (s != end) return 0;
  double found = digits < 20 ? exactly(m, point > 0 ? e - point : e) : NAN;
  if (isnan(found)) {
    char copy[LONGEST], *stop;
    const size_t length = (size_t)(end - begin);
    if (length >= LONGEST) return 0;
    memcpy(copy, begin, length);
    copy[length] = 0;
    if (decimal != '.')
      for (char *at = copy; *at; ++at)
        if (*at == decimal) *at = '.';
    *out = strtod(copy, &stop);
    return stop == copy + length; /* not where a locale has another point */
  }
  *out = negative ? -found : found;
  return 1;
}

/* Reads lines of `count` cells, of which `wanted` are kept; returns the lines, or -1 for what is no such table. */
long cells(const char *s, long size, long count, const unsigned char *wanted, long most, double *out, char separator,
           char decimal) {
  const char *const last = s + size;
  long rows = 0;
  while (s < last) {
    const char *line = memchr(s, '\n', (size_t)(last - s));
    line = line ? line : last;
    if (line == s || (line == s + 1 && *s == '\r')) {
      s = line + 1;
      continue;
    }
    if (rows == most) return -1;
    for (long k = 0; k < count; ++k) {
      const char *end = k < count - 1 ? memchr(s, separator, (size_t)(line - s)) : line;
      if (!end || (k == count - 1 && memchr(s, separator, (size_t)(line - s)))) return -1;
      if (wanted[k] && !number(s, end, decimal, out++)) return -1;
      s = end + 1;
    }
    ++rows;
  }
  return rows;
}
