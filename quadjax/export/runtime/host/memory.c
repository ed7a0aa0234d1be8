/* What a compiler may call where there is no C library, by its own and by the ARM ABI's names. */
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
#define OF_THE_ABI(suffix)                                                                     \
  void __aeabi_memclr##suffix(void *to, size_t size);                                          \
  void __aeabi_memset##suffix(void *to, size_t size, int value);                               \
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size);                        \
  void __aeabi_memclr##suffix(void *to, size_t size) { memset(to, 0, size); }                  \
  void __aeabi_memset##suffix(void *to, size_t size, int value) { memset(to, value, size); }   \
  void __aeabi_memcpy##suffix(void *to, const void *from, size_t size) { memcpy(to, from, size); }
OF_THE_ABI()
OF_THE_ABI(4)
OF_THE_ABI(8)
