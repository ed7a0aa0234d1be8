/* What a compiler may call where there is no C library. */
#include <stddef.h>

void *memset(void *to, int value, size_t size);
void *memcpy(void *restrict to, const void *restrict from, size_t size);
void *memset(void *to, int value, size_t size) {
  volatile unsigned char *byte = to;
  while (size-- != 0U) {
    *byte++ = (unsigned char)value;
  }
  return to;
}
void *memcpy(void *restrict to, const void *restrict from, size_t size) {
  volatile unsigned char *byte = to;
  const unsigned char *source = from;
  while (size-- != 0U) {
    *byte++ = *source++;
  }
  return to;
}
