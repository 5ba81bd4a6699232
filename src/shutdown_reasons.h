/* Every text the firmware can shut down with, once: X(enumerator, text).  The texts are interface: hosts and people
 * match on them, so those that stock boards also send are spelled as there.  The position in the table is the
 * number on the wire (static_string_id); the host learns it from the dictionary, so rows may be added anywhere. */
#ifndef SHUTDOWN_REASONS_H
#define SHUTDOWN_REASONS_H

#define SHUTDOWN_REASONS(X) \
    X(SHUTDOWN_COMMAND_REQUEST, "Command request") \
    X(SHUTDOWN_TIMER_TOO_CLOSE, "Timer too close") \
    X(SHUTDOWN_RESCHEDULED_IN_PAST, "Rescheduled timer in the past") \
    X(SHUTDOWN_NOT_SHUTDOWN, "Shutdown cleared when not shutdown") \
    X(SHUTDOWN_COMMAND_PARSER, "Command parser error") \
    X(SHUTDOWN_INVALID_COMMAND, "Invalid command") \
    X(SHUTDOWN_MESSAGE_ENCODE, "Message encode error") \
    X(SHUTDOWN_ALLOC_CHUNK, "alloc_chunk failed") \
    X(SHUTDOWN_ALLOC_CHUNKS, "alloc_chunks failed") \
    X(SHUTDOWN_OID_ASSIGN, "Can't assign oid") \
    X(SHUTDOWN_OID_TYPE, "Invalid oid type") \
    X(SHUTDOWN_OIDS_ALLOCATED, "oids already allocated") \
    X(SHUTDOWN_ALREADY_FINALIZED, "Already finalized") \
    X(SHUTDOWN_MOVE_OVERFLOW, "Move queue overflow") \
    X(SHUTDOWN_MOVE_SIZE, "Invalid move request size") \
    X(SHUTDOWN_NOT_OUTPUT_PIN, "Not an output pin") \
    X(SHUTDOWN_NOT_INPUT_PIN, "Not an input pin") \
    X(SHUTDOWN_NOT_ADC_PIN, "Not a valid ADC pin") \
    X(SHUTDOWN_NOT_PWM_PIN, "Not a valid PWM pin") \
    X(SHUTDOWN_ADC_RANGE, "ADC out of range") \
    X(SHUTDOWN_ADC_REPORT_SIZE, "Invalid analog_in bytes_per_report") \
    X(SHUTDOWN_DIGITAL_MISSED, "Missed scheduling of next digital out event") \
    X(SHUTDOWN_DIGITAL_EXCEED, "Scheduled digital out event will exceed max_duration") \
    X(SHUTDOWN_DIGITAL_QUEUE, "update_digital_out not valid with active queue") \
    X(SHUTDOWN_SOFT_PWM_CYCLE, "Can not set soft pwm cycle ticks while updates pending") \
    X(SHUTDOWN_PWM_MISSED, "Missed scheduling of next hard pwm event") \
    X(SHUTDOWN_PWM_EXCEED, "Scheduled pwm event will exceed max_duration") \
    X(SHUTDOWN_STEPPER_COUNT, "Invalid count parameter") \
    X(SHUTDOWN_STEPPER_PAST, "Stepper too far in past") \
    X(SHUTDOWN_STEPPER_ACTIVE, "Can't reset time when stepper active") \
    X(SHUTDOWN_SIGNAL_ACTIVE, "Can't add signal that is already active") \
    X(SHUTDOWN_SPI_BUS, "Invalid spi bus") \
    X(SHUTDOWN_SPI_CONFIG, "Invalid spi config") \
    X(SHUTDOWN_SPI_SETUP, "Invalid spi_setup parameters") \
    X(SHUTDOWN_I2C_BUS, "Unsupported i2c bus") \
    X(SHUTDOWN_I2C_SETUP, "Invalid i2c_setup parameters!") \
    X(SHUTDOWN_BUTTONS_MAX, "Max of 8 buttons") \
    X(SHUTDOWN_BUTTONS_POSITION, "Set button past maximum button count") \
    X(SHUTDOWN_BUTTONS_RETRANSMIT, "Invalid buttons retransmit count") \
    X(SHUTDOWN_NEOPIXEL_SIZE, "Invalid neopixel data_size") \
    X(SHUTDOWN_NEOPIXEL_UPDATE, "Invalid neopixel update command") \
    X(SHUTDOWN_THERMOCOUPLE_TYPE, "Invalid thermocouple chip type") \
    X(SHUTDOWN_THERMOCOUPLE_FAULT, "Thermocouple reader fault") \
    X(SHUTDOWN_BUS_TYPE, "bus_type invalid") \
    X(SHUTDOWN_MODEL_TYPE, "model type invalid") \
    X(SHUTDOWN_TMCUART_SIZE, "tmcuart data too large") \
    X(SHUTDOWN_FILTER_SECTION, "Filter section index larger than max_sections") \
    X(SHUTDOWN_HX71X_GAIN, "HX71x gain/channel out of range 1-4") \
    X(SHUTDOWN_ADS131_CHANNELS, "Invalid ads131m0x channels configuration") \
    X(SHUTDOWN_ANGLE_TYPE, "Invalid spi_angle chip type") \
    X(SHUTDOWN_LCD_DELAY, "Invalid display delay") \
    X(SHUTDOWN_ONOFF_TIMEOUT, "Missed renewal of on-off set point") \
    X(SHUTDOWN_ONOFF_SILENT, "On-off heater without readings") \
    X(SHUTDOWN_SUPPLY_SWITCH, "Invalid supply switch interval") \
    /* induction heater */ \
    X(SHUTDOWN_INDUCTION_CONFIG, "Invalid induction configuration") \
    X(SHUTDOWN_INDUCTION_PHASE, "Induction phase out of range") \
    X(SHUTDOWN_INDUCTION_TIMEOUT, "Induction bridge off: no phase command from the host in time") \
    X(SHUTDOWN_INDUCTION_ORDER, "Induction phase commands out of order") \
    X(SHUTDOWN_INDUCTION_LOW, "Induction coil signal below its limit") \
    X(SHUTDOWN_INDUCTION_HIGH, "Induction coil signal above its limit") \
    X(SHUTDOWN_INDUCTION_CLIPPED, "Induction coil signal at the end of the ADC's range") \
    X(SHUTDOWN_INDUCTION_STUCK, "Induction coil signal stands still") \
    X(SHUTDOWN_INDUCTION_UNMOVED, "Induction coil signal does not follow its sampling instant") \
    X(SHUTDOWN_INDUCTION_CONDUCTS, "Induction coil carries current though the bridge is off") \
    X(SHUTDOWN_INDUCTION_JUMP, "Induction coil signal changed faster than a nozzle can") \
    X(SHUTDOWN_BRIDGE_ID, "Not a valid bridge") \
    X(SHUTDOWN_BRIDGE_PERIOD, "Bridge period out of range") \
    X(SHUTDOWN_SYNC_ADC, "Synchronous ADC cannot be set up so") \
    X(SHUTDOWN_BRIDGE_CLOCK, "Bridge refused: its clock does not run as it should") \
    X(SHUTDOWN_BRIDGE_DELAY_LINE, "Bridge refused: the timer's delay line is not calibrated") \
    X(SHUTDOWN_BRIDGE_REGISTERS, "Bridge refused: its registers do not read back as written") \
    X(SHUTDOWN_BRIDGE_ADC, "Bridge refused: the ADC is not calibrated or does not run") \
    X(SHUTDOWN_BRIDGE_FAULT_AT_START, "Bridge refused: the fault line is active") \
    X(SHUTDOWN_BRIDGE_BROWN_OUT, "Bridge refused: the supply dipped, a firmware restart is needed") \
    X(SHUTDOWN_BRIDGE_SUPPLY, "Bridge refused: the supply is too low") \
    X(SHUTDOWN_BRIDGE_FAULT, "Bridge fault line became active") \
    X(SHUTDOWN_BRIDGE_SYSTEM_FAULT, "Bridge stopped: supply, clock or memory failed") \
    X(SHUTDOWN_SAMPLES_STOPPED, "Bridge stopped: the ADC's samples do not arrive") \
    /* ports */ \
    X(SHUTDOWN_PWM_CYCLE, "PWM already programmed at different speed") \
    X(SHUTDOWN_ADC_START, "ADC does not start or cannot be calibrated") \
    X(SHUTDOWN_FLASH_DAMAGED, "Firmware image in flash is damaged")

enum shutdown_reason {
    SHUTDOWN_NONE = 0,
#define X(name, text) name,
    SHUTDOWN_REASONS(X)
#undef X
    SHUTDOWN_REASON_COUNT
};

#endif
