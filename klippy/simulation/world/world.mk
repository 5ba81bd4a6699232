# The simulated world: plants, machine, links and the loop that owns time (see ../README.md).
# Gives SIM_TARGETS its share; the firmware's part, libferrite_mcu.so, has its rule in src/build.mk.

WORLD_DIR     := klippy/simulation/world
PLANT_DIR     := klippy/simulation/plant
WORLD_LIB     := $(OUT)/simulator/libferrite_world.so
WORLD_SOURCES := $(wildcard $(WORLD_DIR)/*.c $(PLANT_DIR)/*.c)
WORLD_INCLUDES := -I$(WORLD_DIR) -I$(PLANT_DIR) -Isrc/simulator
WORLD_OBJECTS := $(WORLD_SOURCES:klippy/simulation/%.c=$(OUT)/simulator/%.o)
# No -ffast-math: the same seed has to give the same trace with every compiler flag that is safe.
WORLD_CFLAGS  := -std=c11 -D_GNU_SOURCE -O3 -flto -g -fPIC -fno-math-errno -fno-semantic-interposition -Wall -Wextra -Werror \
                 $(WORLD_INCLUDES)

SIM_TARGETS += $(WORLD_LIB)

.PHONY: world
world: $(WORLD_LIB)

$(WORLD_OBJECTS): $(OUT)/simulator/%.o: klippy/simulation/%.c $(WORLD_DIR)/world.mk
	@mkdir -p $(@D)
	$(CC) $(WORLD_CFLAGS) -MMD -MP -c $< -o $@

# Linked beside its place and renamed: a running simulation keeps the library it has opened.
$(WORLD_LIB): $(WORLD_OBJECTS)
	$(CC) -shared -Wl,-Bsymbolic -o $@.new $^ -lm -ldl
	@mv $@.new $@

-include $(WORLD_OBJECTS:.o=.d)
# Sources that were there before 0.2.0: what was built from them is built anew.
src/simulator/%.c: ;
