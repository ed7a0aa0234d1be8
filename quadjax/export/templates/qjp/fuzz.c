/*
 * Mutations of a valid .qjp file: FILE COUNT SEED. Not for flight.
 *
 * Half of the mutants get a new hash, so that the checks behind it are tested. Exit status 1: a
 * mutant was accepted although its hash does not match, its ranges do not hold or its commands leave
 * their limits. The sanitizers end the process on any other fault.
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "qjp_layout.h"

__extension__ typedef __int128 wide;

enum { MOST_GROWTH = 4096, ERRORS = QJP_BAD_SELF_TEST + 1, INFERENCES = 4 };

static uint64_t random_state;

static uint32_t draw(uint32_t below) {
  random_state ^= random_state >> 12;
  random_state ^= random_state << 25;
  random_state ^= random_state >> 27;
  return (uint32_t)((random_state * UINT64_C(2685821657736338717)) >> 32) % below;
}

static void fail(const char *message, uint32_t number) {
  printf("mutant %u: %s\n", (unsigned)number, message);
  exit(1);
}

/* A number that is likely to be at the edge of a check. */
static uint32_t edge(uint32_t old) {
  static const uint32_t numbers[] = {0U, 1U, 2U, 3U, 4U, 7U, 8U, 31U, 32U, 33U, 64U, 127U, 128U, 129U,
                                     4096U, 65536U, 0x3FFFFFFFU, 0x40000000U, 0x40000001U,
                                     0x7FFFFFFFU, 0x80000000U, 0xC0000000U, 0xFFFFFFFFU};
  const uint32_t kind = draw(4U);
  if (kind == 0U) {
    return old + 1U;
  }
  if (kind == 1U) {
    return old - 1U;
  }
  return (kind == 2U) ? numbers[draw(sizeof(numbers) / sizeof(numbers[0]))] : draw(0xFFFFFFFFU);
}

static void set_word(uint8_t *data, uint32_t at, uint32_t value) { memcpy(data + at, &value, 4U); }

static uint32_t word_at(const uint8_t *data, uint32_t at) {
  uint32_t value;
  memcpy(&value, data + at, 4U);
  return value;
}

/* Edits a file in place; returns its size. */
static uint32_t mutate(uint8_t *data, uint32_t size) {
  const uint32_t at = draw(size);
  const uint32_t words = (size < 8U) ? 1U : size / 4U;
  uint32_t length = 1U + draw(200U);
  length = (at + length > size) ? size - at : length;
  switch (draw(8U)) {
    case 0U:
      data[at] ^= (uint8_t)(1U << draw(8U));
      break;
    case 1U: /* cut off */
      return 1U + at;
    case 2U: /* longer */
      memset(data + size, (int)draw(256U), length);
      return size + length;
    case 3U: /* a part over another */
      memmove(data + at, data + draw(size - length + 1U), length);
      break;
    case 4U: /* a part removed */
      memmove(data + at, data + at + length, size - at - length);
      return (size > length) ? size - length : 1U;
    case 5U: /* a word of the header or of what follows it */
      if (size >= 4U) {
        const uint32_t limit = (draw(2U) == 0U) ? QJP_HEADER_WORDS : 4U * QJP_HEADER_WORDS;
        const uint32_t word = 4U * draw((words < limit) ? words : limit);
        set_word(data, word, edge(word_at(data, word)));
      }
      break;
    case 6U: /* any word */
      if (size >= 4U) {
        const uint32_t word = 4U * draw(words);
        set_word(data, word, edge(word_at(data, word)));
      }
      break;
    default:
      memset(data + at, (draw(2U) == 0U) ? 0 : 255, length);
      break;
  }
  return size;
}

/* The size in the header and the hash, made right. */
static void rehash(uint8_t *data, uint32_t size) {
  if ((size >= 64U) && (size % 4U == 0U)) {
    if (draw(4U) != 0U) {
      set_word(data, 4U * QJP_AT_BYTES, size);
    }
    qjp_sha256(data, size - 32U, data + size - 32U);
  }
}

static int has_hash(const uint8_t *data, uint32_t size) {
  uint8_t digest[32];
  if (size < 32U) {
    return 0;
  }
  qjp_sha256(data, size - 32U, digest);
  return memcmp(digest, data + size - 32U, 32U) == 0;
}

static wide size_of(wide value) { return (value < 0) ? -value : value; }

/* The ranges of a layer in 128 bits, by other code than the loader's. */
static int in_range(const qjp_layer *layer, int hidden, wide *low, wide *high) {
  wide next[2][QJP_MAX_WIDTH];
  for (uint32_t row = 0U; row < layer->padded_rows; ++row) {
    const wide bias = qjp_long(layer->bias + 2U * row);
    wide total = size_of(bias);
    next[0][row] = next[1][row] = bias;
    for (uint32_t i = 0U; i < layer->padded_columns; ++i) {
      const wide w = layer->weights[(row / 4U * layer->padded_columns + i) * 4U + row % 4U];
      total += size_of(w) * ((size_of(low[i]) > size_of(high[i])) ? size_of(low[i])
                                                                 : size_of(high[i]));
      next[0][row] += (w < 0) ? w * high[i] : w * low[i];
      next[1][row] += (w < 0) ? w * low[i] : w * high[i];
    }
    if (total >= ((wide)1 << 63)) {
      return 0;
    }
    for (uint32_t end = 0U; end < 2U; ++end) {
      next[end][row] = (next[end][row] < 0) ? 0 : next[end][row] >> 32;
      if (hidden && (next[end][row] >= ((wide)1 << 30))) {
        return 0;
      }
    }
  }
  memcpy(low, next[0], sizeof(next[0]));
  memcpy(high, next[1], sizeof(next[1]));
  return 1;
}

static void check_ranges(const qjp_policy *policy, uint32_t number) {
  wide low[QJP_MAX_WIDTH] = {0};
  wide high[QJP_MAX_WIDTH] = {0};
  for (uint32_t i = 0U; i < policy->inputs; ++i) {
    high[i] = (wide)1 << 30;
    low[i] = -high[i];
  }
  for (uint32_t i = 0U; i < policy->layers; ++i) {
    if (!in_range(&policy->layer[i], i + 1U < policy->layers, low, high)) {
      fail("accepted, but its ranges do not hold", number);
    }
  }
}

/* Flies an accepted mutant in states of any bits. */
static void check_commands(const qjp_policy *policy, uint32_t number) {
  float state[QJP_MAX_STATE];
  int32_t q[QJP_MAX_WIDTH];
  int32_t command[QJP_COMMANDS];
  float commands[QJP_COMMANDS];
  qjp_race race;
  for (uint32_t i = 0U; i < INFERENCES; ++i) {
    for (uint32_t k = 0U; k < QJP_MAX_STATE; ++k) {
      const uint32_t bits = (draw(4U) == 0U) ? draw(0xFFFFFFFFU) : 0x3F800000U + draw(0x2000000U);
      memcpy(&state[k], &bits, 4U);
    }
    qjp_race_start(policy, &race, state, draw(64U));
    (void)qjp_race_update(policy, &race, state + 3);
    (void)qjp_observe(policy, state, race.target, q);
    qjp_forward(policy, q, command, 0);
    qjp_commands(policy, command, commands);
    (void)qjp_observes(policy, QJP_ROTOR_SPEED);
    (void)qjp_is_motor_policy(policy);
    for (uint32_t k = 0U; k < QJP_COMMANDS; ++k) {
      if ((command[k] < policy->low[k]) || (command[k] > policy->high[k])) {
        fail("accepted, but a command leaves its limits", number);
      }
    }
  }
}

/* Mutates the file once; returns whether it is unchanged, and the error. */
static int one(const uint8_t *file, uint32_t size, uint32_t number, qjp_error *error) {
  uint8_t *const work = malloc(size + MOST_GROWTH);
  const uint32_t edits = 1U + ((draw(4U) == 0U) ? draw(8U) : 0U);
  uint32_t length = size;
  qjp_policy policy;
  memcpy(work, file, size);
  for (uint32_t i = 0U; i < edits; ++i) {
    length = mutate(work, length);
  }
  if (draw(2U) == 0U) {
    rehash(work, length);
  }
  const int same = (length == size) && (memcmp(work, file, size) == 0);
  const int hashed = has_hash(work, length);
  uint8_t *const exact = malloc(length); /* nothing behind it: the sanitizer sees every read there */
  memcpy(exact, work, length);
  memset(&policy, 0xA5, sizeof(policy));
  *error = qjp_load(&policy, (const int32_t *)(const void *)exact, length);
  if (*error == QJP_OK) {
    if (!hashed) {
      fail("accepted without a matching hash", number);
    }
    check_ranges(&policy, number);
    check_commands(&policy, number);
  } else if (same) {
    fail("rejected, but it is the file itself", number);
  }
  free(exact);
  free(work);
  return same;
}

int main(int argc, char **argv) {
  static uint32_t counts[ERRORS];
  uint32_t same = 0U;
  FILE *const in = (argc == 4) ? fopen(argv[1], "rb") : 0;
  if (in == 0) {
    return 2;
  }
  const uint32_t count = (uint32_t)strtoul(argv[2], 0, 10);
  random_state = strtoull(argv[3], 0, 10) * 2U + 1U;
  (void)fseek(in, 0, SEEK_END);
  const uint32_t size = (uint32_t)ftell(in);
  rewind(in);
  uint8_t *const file = malloc(size);
  if ((fread(file, 1U, size, in) != size) || (fclose(in) != 0)) {
    return 2;
  }
  for (uint32_t i = 0U; i < count; ++i) {
    qjp_error error;
    same += (uint32_t)one(file, size, i, &error);
    ++counts[error];
  }
  printf("mutants %u\nunchanged %u\n", (unsigned)count, (unsigned)same);
  for (uint32_t i = 0U; i < ERRORS; ++i) {
    printf("%s %u\n", qjp_error_name((qjp_error)i), (unsigned)counts[i]);
  }
  free(file);
  return 0;
}
