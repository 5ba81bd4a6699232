# ATmega2560, as on an Arduino Mega 2560 with a RAMPS shield: 16 MHz, 256 KiB flash, 8 KiB RAM.
PORT_CROSS := avr-
PORT_CC := $(PORT_CROSS)gcc
PORT_OBJCOPY := $(PORT_CROSS)objcopy
PORT_SIZE := $(PORT_CROSS)size

# No bridge, no LED chains (their pulses are shorter than a look at the clock takes), I2C by software.
PORT_FIRMWARE := $(FIRMWARE_CORE) src/timed_output.c src/gpiocmds.c src/pwmcmds.c src/adccmds.c src/trsync.c src/stepper.c \
	src/endstop.c src/onoffcmds.c $(FIRMWARE_BUS) src/spi_hardware.c src/buttons.c src/pulse_counter.c src/tmcuart.c
MEGA := src/atmega2560
PORT_SOURCES := $(MEGA)/boot.c $(MEGA)/timer.c $(MEGA)/gpio.c $(MEGA)/console.c $(MEGA)/adc.c $(MEGA)/pwm.c $(MEGA)/spi.c

# Options with their defaults.
MEGA_BAUD := $(or $(CONFIG_SERIAL_BAUD),250000)
MEGA_STACK := 768

PORT_CFLAGS := -mmcu=atmega2560 -O2 -flto -DCONFIG_SERIAL_BAUD=$(MEGA_BAUD)UL
PORT_PREFIX_MAP := -fdebug-prefix-map
# Between the variables and the stack lies the arena; avr-ld puts RAM at 0x800000.
MEGA_MEMORY := -Wl,--defsym=stack_top=0x802200 -Wl,--defsym=stack_limit=0x802200-$(MEGA_STACK) \
	-Wl,--defsym=arena_start=__heap_start -Wl,--defsym=arena_end=stack_limit
# The linker wants to know what the compiler does when it compiles there.
PORT_LDFLAGS := $(C_WARNINGS) -fwhole-program $(MEGA_MEMORY)
PORT_IMAGES := ferrite.hex
PORT_FLASH_CMD = avrdude -p atmega2560 -c wiring -P $(or $(FLASH_DEVICE),/dev/ttyACM0) -b 115200 -D \
	-U flash:w:$(PORT_OUT)/ferrite.hex:i
