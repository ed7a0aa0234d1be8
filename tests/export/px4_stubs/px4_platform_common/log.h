#pragma once
#include <stdio.h>
#define PX4_INFO(...) (printf(__VA_ARGS__), printf("\n"))
#define PX4_WARN(...) PX4_INFO(__VA_ARGS__)
#define PX4_ERR(...) PX4_INFO(__VA_ARGS__)
