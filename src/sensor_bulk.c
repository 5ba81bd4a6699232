/* Many small samples of one sensor to the host; see sensor_bulk.h. */
#include "sensor_bulk.h"

#include "command.h"

DECL_RESPONSE(response_bulk_data, "sensor_bulk_data oid=%c sequence=%hu data=%*s");
DECL_RESPONSE(response_bulk_status, "sensor_bulk_status oid=%c clock=%u query_ticks=%u next_sequence=%hu buffered=%u"
              " possible_overflows=%hu");

void
sensor_bulk_reset(struct sensor_bulk *b)
{
    b->sequence = b->possible_overflows = 0;
    b->len = 0;
}

void
sensor_bulk_send(struct sensor_bulk *b, uint8_t oid)
{
    if (!b->len)
        return;
    respond(&response_bulk_data, oid, b->sequence++, (unsigned int)b->len, b->data);
    b->len = 0;
}

void
sensor_bulk_status(struct sensor_bulk *b, uint8_t oid, uint32_t clock, uint32_t query_ticks, uint32_t buffered)
{
    respond(&response_bulk_status, oid, clock, query_ticks, b->sequence, buffered, b->possible_overflows);
}
