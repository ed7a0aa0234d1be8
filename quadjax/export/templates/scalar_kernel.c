/* Columns that a turn of the scalar kernel takes; every count of columns is a multiple of it. */
enum { COLUMNS_PER_TURN = 8 };

/* Two rows at a time: their sums, their weights and the input are what the registers of a 32-bit ARM
 * hold without spilling. ${NAME}_PORTABLE leaves the assembly out. */
#if defined(__arm__) && defined(__GNUC__) && defined(__ARM_ARCH) && !defined(${NAME}_PORTABLE)
#if (__ARM_ARCH >= 7) && (defined(__ARM_ARCH_ISA_ARM) || (__ARM_ARCH_ISA_THUMB >= 2))
#define HAS_SMLAL 1
#endif
#endif

#ifdef HAS_SMLAL
/* Every ARMv7 has LDRD and SMLAL, Cortex-M included; compilers use the first one rarely. Two
 * columns: weights at offset a and b, inputs in r8 and r9. */
#define TWO_COLUMNS(first, second) \
  "ldrd r8, r9, [%[x]], #8\n\t" first "ldrd r4, r5, [%[w], #" second "]\n\t" \
  "smlal %Q[a], %R[a], r2, r8\n\tsmlal %Q[b], %R[b], r3, r8\n\t" \
  "smlal %Q[a], %R[a], r4, r9\n\tsmlal %Q[b], %R[b], r5, r9\n\t"
#define WEIGHTS(offset) "ldrd r2, r3, [%[w], #" offset "]\n\t"

static inline void sums_of_two(const int32_t *weight, const int64_t *bias, const int32_t *x,
                               uint32_t columns, int64_t sums[2]) {
  int64_t sum_0 = bias[0];
  int64_t sum_1 = bias[1];
  for (const int32_t *const end = x + columns; x != end;) {
    __asm__(TWO_COLUMNS("ldrd r2, r3, [%[w]], #128\n\t", "-112")
            TWO_COLUMNS(WEIGHTS("-96"), "-80")
            TWO_COLUMNS(WEIGHTS("-64"), "-48")
            TWO_COLUMNS(WEIGHTS("-32"), "-16")
            : [a] "+r"(sum_0), [b] "+r"(sum_1), [w] "+r"(weight), [x] "+r"(x)
            :
            : "r2", "r3", "r4", "r5", "r8", "r9", "memory");
  }
  sums[0] = sum_0;
  sums[1] = sum_1;
}
#else
static inline void sums_of_two(const int32_t *restrict weight, const int64_t *restrict bias,
                               const int32_t *restrict x, uint32_t columns, int64_t sums[2]) {
  int64_t sum_0 = bias[0];
  int64_t sum_1 = bias[1];
  for (const int32_t *const end = x + columns; x != end; x += COLUMNS_PER_TURN) {
    for (uint32_t column = 0U; column < (uint32_t)COLUMNS_PER_TURN; ++column) {
      const int64_t value = x[column];
      sum_0 += weight[0] * value;
      sum_1 += weight[1] * value;
      weight += ROWS_PER_BLOCK;
    }
  }
  sums[0] = sum_0;
  sums[1] = sum_1;
}
#endif

KERNEL void sums_scalar(const int32_t *restrict weight, const int64_t *restrict bias,
                        const int32_t *restrict x, uint32_t columns,
                        int64_t sums[ROWS_PER_BLOCK]) {
  sums_of_two(weight, bias, x, columns, sums);
  sums_of_two(weight + 2, bias + 2, x, columns, sums + 2);
}
