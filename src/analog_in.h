/* Values of a slow analog input (adccmds.c) for other parts of the firmware, besides the host's reports. */
#ifndef ANALOG_IN_H
#define ANALOG_IN_H

#include <stdint.h>

struct analog_listener {
    void (*on_value)(struct analog_listener *l, uint16_t value); /* timer context; the plain sum of a group */
};

/* One listener an input; task context.  Shuts down if `oid` is no analog input. */
void analog_in_listen(uint8_t oid, struct analog_listener *l);

#endif
