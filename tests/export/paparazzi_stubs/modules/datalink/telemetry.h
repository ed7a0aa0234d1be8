#ifndef TELEMETRY_H
#define TELEMETRY_H
#include <stdint.h>
struct transport_tx { int unused; };
struct link_device { int unused; };
typedef void (*telemetry_cb)(struct transport_tx *trans, struct link_device *dev);
struct periodic_telemetry { int unused; };
extern struct periodic_telemetry *DefaultPeriodic;
#define PPRZ_MSG_ID_PAYLOAD_FLOAT 222
int8_t register_periodic_telemetry(struct periodic_telemetry *pt, uint8_t id, telemetry_cb cb);
void pprz_msg_send_PAYLOAD_FLOAT(struct transport_tx *trans, struct link_device *dev, uint8_t id,
                                 uint8_t count, float *values);
#endif
