# ATmega2560, as on an Arduino Mega 2560 with a RAMPS shield: 16 MHz, 256 KiB flash, 8 KiB RAM.
PORT_CROSS := avr-
PORT_CC := $(PORT_CROSS)gcc
PORT_OBJCOPY := $(PORT_CROSS)objcopy
PORT_PACKAGES := gcc-avr avr-libc

# No bridge.
PORT_FIRMWARE := $(FIRMWARE_CORE) src/timed_output.c src/gpiocmds.c src/pwmcmds.c src/adccmds.c src/trsync.c src/stepper.c \
	src/endstop.c src/onoffcmds.c src/supplycmds.c $(FIRMWARE_BUS) $(FIRMWARE_BUS_HARDWARE) $(FIRMWARE_PINS)
MEGA := src/atmega2560
PORT_SOURCES := $(MEGA)/boot.c $(MEGA)/timer.c $(MEGA)/gpio.c $(MEGA)/console.c $(MEGA)/adc.c $(MEGA)/pwm.c $(MEGA)/spi.c \
	$(MEGA)/i2c.c $(MEGA)/led.c

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
# Its boot loader erases each page as it is written: -D.
PORT_FLASH_DEVICE = $(or $(FLASH_DEVICE),/dev/ttyACM0)
PORT_FLASH_CMD = avrdude -p atmega2560 -c wiring -P $(PORT_FLASH_DEVICE) -b 115200 -D \
	-U flash:w:$(PORT_OUT)/ferrite.hex:i
