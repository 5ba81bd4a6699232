#include "internal.h"

void samples_irq(void);
void adc_irq(void);
void bridge_fault_irq(void);
void nmi_handler(void);
void bridge_stop(void);

void samples_irq(void) {}
void adc_irq(void) {}
void bridge_fault_irq(void) {}
void nmi_handler(void) {}
void bridge_stop(void) {}
