/* Start of a program on an emulated Cortex-M board: stack, FPU, and the C library's own start. */
#include <stdint.h>

void start_board(void);
extern void _start(void);
#define TOP_OF_MEMORY UINT32_C(0x20400000)
#define FPU_ACCESS (*(volatile uint32_t *)UINT32_C(0xE000ED88))

void start_board(void) {
  FPU_ACCESS |= UINT32_C(0xF) << 20;
  _start();
}

__attribute__((section(".vectors"), used)) static const struct {
  uint32_t stack;
  void (*handler[15])(void);
} vectors = {TOP_OF_MEMORY, {start_board}};
