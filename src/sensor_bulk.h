/* Many small samples of one sensor to the host, several in a message.
 *
 * A message has as many whole samples as fit; its sequence counts messages since the start, so that the host sees a
 * lost one. `possible_overflows` counts readings at which the sensor's own memory was full or its bus failed. */
#ifndef SENSOR_BULK_H
#define SENSOR_BULK_H

#include <stdint.h>

enum { SENSOR_BULK_SIZE = 52 };  /* content is 59 bytes: id 2, oid 1, sequence 3, length 1 */

struct sensor_bulk {
    uint16_t sequence, possible_overflows;
    uint8_t len;
    uint8_t data[SENSOR_BULK_SIZE];
};

/* All in task context. */
void sensor_bulk_reset(struct sensor_bulk *b);
/* Sends what there is, if anything. */
void sensor_bulk_send(struct sensor_bulk *b, uint8_t oid);
/* `buffered` bytes are here or in the sensor; read at `clock`, which took `query_ticks`. */
void sensor_bulk_status(struct sensor_bulk *b, uint8_t oid, uint32_t clock, uint32_t query_ticks, uint32_t buffered);

#endif
