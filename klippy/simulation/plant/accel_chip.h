/* The registers and the sample memory (FIFO) of six accelerometers, as their data sheets have them.
 *
 *   chip       identity       data sheet, sections
 *   ADXL345    0x00 = 0xe5    Analog Devices rev. E: Register Map, FIFO, Table 7 (output data rates)
 *   LIS2DW12   0x0f = 0x44    ST DocID030730: 8 (registers), 5.1 (FIFO)
 *   LIS3DH     0x0f = 0x33    ST DocID17530: 8 (registers), 5.1 (FIFO)
 *   MPU-9250   0x75 = 0x71    InvenSense RM-MPU-9250A-00: 4.6 to 4.8, 4.11, 4.26 to 4.29
 *   ICM-20948  0x00 = 0xea    InvenSense DS-000189: 8 (banks 0 and 2)
 *   BMI160     0x00 = 0xd1    Bosch BST-BMI160-DS000: 2.11 (registers), 2.5 (FIFO)
 *
 * Only what concerns acceleration is there: rate, range, FIFO. A register that is none of those keeps what is written.
 * The chip takes a sample when its owner says so, at the rate it is asked for; it knows neither time nor bus.
 */
#ifndef FERRITE_ACCEL_CHIP_H
#define FERRITE_ACCEL_CHIP_H

#include <stdint.h>

enum accel_kind { ACCEL_ADXL345, ACCEL_LIS2DW, ACCEL_LIS3DH, ACCEL_MPU9250, ACCEL_ICM20948, ACCEL_BMI160,
                  ACCEL_KINDS };
enum accel_fault { ACCEL_WORKS, ACCEL_UNPLUGGED, ACCEL_FROZEN, ACCEL_SATURATED };
enum { ACCEL_FIFO_MAX = 170, ACCEL_BANKS = 4 };

struct accel_chip {
    enum accel_kind kind;
    uint8_t registers[ACCEL_BANKS][256];
    uint8_t bank;
    int16_t fifo[ACCEL_FIFO_MAX][3];
    int fifo_first, fifo_count, overrun;
    int byte; /* of the oldest sample that has been read */
    uint8_t address;
    int place; /* in an SPI transfer: bytes so far */
    int is_read;
};

void accel_chip_init(struct accel_chip *c, enum accel_kind kind);
/* Samples a second that the registers ask for; 0: off. */
double accel_chip_rate(const struct accel_chip *c);
/* ug/sqrt(Hz), typical, of the data sheet. */
double accel_chip_noise(enum accel_kind kind);
/* A sample, m/s^2; clipped at the range. */
void accel_chip_sample(struct accel_chip *c, const double accel_m_s2[3]);

void accel_chip_spi_select(struct accel_chip *c);
uint8_t accel_chip_spi_byte(struct accel_chip *c, uint8_t sent);
void accel_chip_i2c(struct accel_chip *c, const uint8_t *write, uint32_t write_len, uint8_t *read, uint32_t read_len);

#endif
