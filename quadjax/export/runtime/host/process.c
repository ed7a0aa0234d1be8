/* A process that answers every state by a command: sil_process ADDRESS PORT; without
 * them it says why the policy cannot fly. It ends with the message
 * SIL_END, or when its standard input is closed. */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "message.h"

enum { CHECKED = 16 };

static struct {
  int begun;         /* whether a state was accepted */
  uint32_t run;      /* of the newest state */
  uint32_t sequence; /* of the newest state */
  uint32_t rejected; /* since the start of the process */
} newest;

/* CRC-32 of IEEE 802.3, reflected, as zlib computes it. */
static uint32_t crc32_of(const unsigned char *bytes, size_t count) {
  uint32_t crc = 0xFFFFFFFFU;
  for (size_t i = 0U; i < count; ++i) {
    crc ^= bytes[i];
    for (int bit = 0; bit < 8; ++bit) {
      crc = (crc >> 1) ^ (0xEDB88320U & (0U - (crc & 1U)));
    }
  }
  return ~crc;
}

static void send_message(int socket, void *message, uint32_t size, uint16_t kind) {
  sil_header *header = message;
  memcpy(header->magic, "QSIL", 4);
  header->version = SIL_VERSION;
  header->kind = kind;
  header->length = size;
  header->crc32 = crc32_of((const unsigned char *)message + CHECKED, size - CHECKED);
  (void)send(socket, message, size, 0);
}

/* Whether a datagram is a message of this version, whole and unchanged. */
static int is_intact(const unsigned char *bytes, size_t size) {
  sil_header header;
  if (size < sizeof(header)) {
    return 0;
  }
  memcpy(&header, bytes, sizeof(header));
  return memcmp(header.magic, "QSIL", 4) == 0 && header.version == SIL_VERSION &&
         header.length == size && header.crc32 == crc32_of(bytes + CHECKED, size - CHECKED);
}

/* Whether a state is newer than all before it; a new run begins with its first state. */
static int is_new(const sil_header *header) {
  if (newest.begun && header->run == newest.run && header->sequence <= newest.sequence) {
    return 0;
  }
  if (newest.begun && header->run < newest.run) {
    return 0;
  }
  if (!newest.begun || header->run != newest.run) {
    sil_begin();
  }
  newest.begun = 1;
  newest.run = header->run;
  newest.sequence = header->sequence;
  return 1;
}

static void answer(int socket, const sil_state *state) {
  sil_command command;
  memset(&command, 0, sizeof(command));
  command.header.run = state->header.run;
  command.header.sequence = state->header.sequence;
  command.header.time_s = state->header.time_s;
  command.command_kind = COMMAND_KIND;
  sil_step(state, &command);
  command.rejected_messages = newest.rejected;
  send_message(socket, &command, sizeof(command), SIL_COMMAND);
}

/* One datagram; returns whether it ends the process. */
static int process(int socket) {
  union {
    unsigned char bytes[2048];
    sil_state state;
  } in;
  const ssize_t size = recv(socket, in.bytes, sizeof(in.bytes), 0);
  if (size < 0) {
    return 1;
  }
  if (!is_intact(in.bytes, (size_t)size)) {
    ++newest.rejected;
  } else if (in.state.header.kind == SIL_END) {
    return 1;
  } else if (in.state.header.kind != SIL_STATE || (size_t)size != sizeof(sil_state) ||
             !is_new(&in.state.header)) {
    ++newest.rejected;
  } else {
    answer(socket, &in.state);
  }
  return 0;
}

int main(int count, char **values) {
  struct sockaddr_in address;
  sil_hello hello;
  memset(&address, 0, sizeof(address));
  memset(&hello, 0, sizeof(hello));
  const char *const wrong = sil_load();
  if (count == 1) { /* whether the policy can fly */
    return (printf("%s\n", (wrong != 0) ? wrong : "") < 0) ? 2 : (int)(sil_own_estimator() & 1U);
  }
  const int socket_number = socket(AF_INET, SOCK_DGRAM, 0);
  if (count != 3 || socket_number < 0 || inet_pton(AF_INET, values[1], &address.sin_addr) != 1) {
    return 2;
  }
  address.sin_family = AF_INET;
  address.sin_port = htons((uint16_t)atoi(values[2]));
  if (connect(socket_number, (struct sockaddr *)&address, sizeof(address)) != 0) {
    return 2;
  }
  hello.command_kind = COMMAND_KIND;
  hello.self_test_mismatches = (wrong != 0) ? 1U : 0U;
  send_message(socket_number, &hello, sizeof(hello), SIL_HELLO);
  struct pollfd waiting[2] = {{socket_number, POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}};
  while (poll(waiting, 2, -1) > 0 && waiting[1].revents == 0) {
    if (waiting[0].revents != 0 && process(socket_number)) {
      break;
    }
  }
  return close(socket_number);
}
