/* The words of ${name}.qjp, little-endian, in flash. */
#ifndef QJP_DATA_H
#define QJP_DATA_H

#include <stdint.h>

${table("int32_t", "qjp_data", words)}

#endif /* QJP_DATA_H */
