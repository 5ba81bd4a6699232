/* Chips that digitise a probe's force or frequency, as their buses show them; written from their data sheets.
 *
 *   HX711, HX717     DOUT low: a conversion has ended. Each SCLK pulse shifts a bit out, 25 to 28 in all choose the next
 *                    channel and gain; after them DOUT is high (Avia, serial interface).
 *   ADS1220          RESET 06, START 08, RREG 2x, WREG 4x; without a command 24 bits of data (SBAS501, 8.5 and 8.6)
 *   ADS131M02, M04   frames of 24-bit words: NULL 0000, RESET 0011, RREG Axxx, WREG 6xxx; the answer comes in the next
 *                    frame; status, channels and a check sum in each (SBAS890, 8.5 and 8.6)
 *   LDC1612          registers of 16 bits on I2C; DATA0 in 28 bits, conversion time, current, errors (SNOSCY9)
 */
#ifndef FERRITE_GAUGE_CHIP_H
#define FERRITE_GAUGE_CHIP_H

#include <stdint.h>

enum gauge_kind { GAUGE_HX711, GAUGE_HX717, GAUGE_ADS1220, GAUGE_ADS131M02, GAUGE_ADS131M04, GAUGE_LDC1612, GAUGE_KINDS };
enum { GAUGE_FRAME_WORDS = 6, GAUGE_REGISTERS = 128 };

struct gauge_chip {
    enum gauge_kind kind;
    double clock_hz;           /* of ADS131M0x and LDC1612 */
    double line_rate_hz;       /* of HX71x, by its wiring */
    int32_t sample;            /* of the last conversion */
    int fresh;                 /* not read yet */
    int running;               /* ADS1220: started */
    /* HX71x */
    uint8_t level, pulses;
    uint32_t shift;
    /* registers */
    uint16_t registers[GAUGE_REGISTERS];
    uint8_t frame[GAUGE_FRAME_WORDS * 3], frame_len;
    uint16_t answer;
    double drive_optimum;      /* LDC1612: current code of the right amplitude */
};

void gauge_chip_init(struct gauge_chip *c, enum gauge_kind kind, double clock_hz, double line_rate_hz);
/* Conversions a second; 0: it does not convert. */
double gauge_chip_rate(const struct gauge_chip *c);
/* A conversion has ended. `signal`: of full scale, -1 to 1; LDC1612: Hz. */
void gauge_chip_convert(struct gauge_chip *c, double signal);
/* The line that says that there is data: 0 while there is. */
uint8_t gauge_chip_ready(const struct gauge_chip *c);
void gauge_chip_clock(struct gauge_chip *c, uint8_t level);                   /* HX71x: SCLK */
void gauge_chip_select(struct gauge_chip *c);                                 /* SPI: a frame begins */
void gauge_chip_spi(struct gauge_chip *c, uint8_t *data, uint32_t len);       /* a frame, whole */
void gauge_chip_i2c(struct gauge_chip *c, const uint8_t *write, uint32_t write_len, uint8_t *read, uint32_t read_len);

#endif
