# The simulated world: plants, machine, links and the loop that owns time (see README.md in this folder).
# Gives SIM_TARGETS its share; the firmware's part, libferrite_mcu.so, has its rule in src/build.mk.

WORLD_DIR     := src/simulator
WORLD_LIB     := $(OUT)/simulator/libferrite_world.so
WORLD_SOURCES := $(wildcard $(WORLD_DIR)/world*.c $(WORLD_DIR)/machine*.c $(WORLD_DIR)/plant*.c) \
                 $(WORLD_DIR)/thermal_load.c
WORLD_OBJECTS := $(WORLD_SOURCES:$(WORLD_DIR)/%.c=$(OUT)/simulator/world/%.o)
# No -ffast-math: the same seed has to give the same trace with every compiler flag that is safe.
WORLD_CFLAGS  := -std=c11 -D_GNU_SOURCE -O2 -g -fPIC -fno-math-errno -fvisibility=default -Wall -Wextra -Werror \
                 -I$(WORLD_DIR) -Isrc

SIM_TARGETS += $(WORLD_LIB)

.PHONY: world
world: $(WORLD_LIB)

$(OUT)/simulator/world/%.o: $(WORLD_DIR)/%.c $(WORLD_DIR)/world.mk
	@mkdir -p $(@D)
	$(CC) $(WORLD_CFLAGS) -MMD -MP -c $< -o $@

# Linked beside its place and renamed: a running simulation keeps the library it has opened.
$(WORLD_LIB): $(WORLD_OBJECTS)
	$(CC) -shared -o $@.new $^ -lm -ldl
	@mv $@.new $@

-include $(WORLD_OBJECTS:.o=.d)
