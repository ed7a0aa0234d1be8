#pragma once
#include <stdint.h>
uint32_t get_sys_time_usec(void);
