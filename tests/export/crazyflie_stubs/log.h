#pragma once
#define LOG_GROUP_START(name) static const void *const stub_log_##name[] = {
#define LOG_ADD(type, name, address) address,
#define LOG_GROUP_STOP(name) 0}; \
  const void *const *stub_logged(void); \
  const void *const *stub_logged(void) { return stub_log_##name; }
