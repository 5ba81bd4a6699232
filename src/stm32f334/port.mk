# STM32F334R8, as on the Nucleo-F334R8: 72 MHz, 64 KiB flash, 12 KiB SRAM + 4 KiB CCM.
PORT_CROSS := arm-none-eabi-
PORT_CC := $(PORT_CROSS)gcc
PORT_OBJCOPY := $(PORT_CROSS)objcopy
PORT_PACKAGES := gcc-arm-none-eabi libnewlib-arm-none-eabi

PORT_FIRMWARE := $(FIRMWARE_SOURCES) $(FIRMWARE_EXTRAS)
F334 := src/stm32f334
# boot.c last: its DECL_INIT may shut down, when everything else is ready to report it.
PORT_SOURCES := $(F334)/startup.c $(F334)/clock.c $(F334)/timer.c $(F334)/gpio.c $(F334)/console.c $(F334)/seal.c \
	$(F334)/watchdog.c $(F334)/bridge.c $(F334)/sync_adc.c \
	$(F334)/adc.c $(F334)/pwm.c $(F334)/spi.c $(F334)/i2c.c $(F334)/boot.c

# Options with their defaults (src/stm32f334/Kconfig).
F334_HSE_BYPASS := $(if $(filter y,$(CONFIG_F334_CRYSTAL)),0,1)
F334_BAUD := $(or $(CONFIG_SERIAL_BAUD),250000)
F334_DEAD_TIME_NS := $(or $(CONFIG_F334_DEAD_TIME_NS),200)
F334_FAULT_ACTIVE_HIGH := $(if $(filter y,$(CONFIG_F334_FAULT_ACTIVE_HIGH)),1,0)
F334_STACK := 2048
F334_RAM_BUDGET := 11264

PORT_CFLAGS := -mcpu=cortex-m4 -mthumb -mfloat-abi=soft -O2 -flto -flto-partition=none -ffreestanding -fbuiltin -DPORT_OVERSAMPLE_KERNEL \
	-DCONFIG_HSE_BYPASS=$(F334_HSE_BYPASS) -DCONFIG_SERIAL_BAUD=$(F334_BAUD) \
	-DCONFIG_DEAD_TIME_NS=$(F334_DEAD_TIME_NS) -DCONFIG_FAULT_ACTIVE_HIGH=$(F334_FAULT_ACTIVE_HIGH)
PORT_LINK_INPUTS := $(F334)/link.ld
PORT_LDFLAGS := -nostartfiles -specs=nano.specs -T $(F334)/link.ld \
	-Wl,--defsym=STACK_SIZE=$(F334_STACK) -Wl,--defsym=RAM_BUDGET=$(F334_RAM_BUDGET)
PORT_IMAGES := ferrite.bin
PORT_SEAL := $(PORT_PYTHON) scripts/build/seal_firmware.py
PORT_FLASH_CMD = openocd -f board/st_nucleo_f3.cfg -c "program $(PORT_ELF) verify reset exit"
