/* A filter of second-order sections in fixed point; see sos_filter.h. */
#include "sos_filter.h"

#include "basecmd.h"
#include "command.h"
#include "sched.h"

enum { SECTION_COEFFICIENTS = 5, SECTION_STATES = 2 };

struct sos_section {
    int32_t coefficient[SECTION_COEFFICIENTS];  /* b0 b1 b2 a1 a2 */
    int32_t first_state[SECTION_STATES], state[SECTION_STATES];
};

struct sos_filter {
    int32_t offset, scale;
    uint8_t max_sections, sections, coeff_frac_bits, scale_frac_bits;
    uint8_t auto_offset, wants_offset;
    struct sos_section section[];
};

static uint8_t sos_filter_type;

struct sos_filter *
sos_filter_lookup(uint8_t oid)
{
    return oid_lookup(oid, &sos_filter_type);
}

void
sos_filter_reset(struct sos_filter *f)
{
    f->wants_offset = f->auto_offset;
    for (uint8_t i = 0; i < f->sections; i++)
        for (uint8_t k = 0; k < SECTION_STATES; k++)
            f->section[i].state[k] = f->section[i].first_state[k];
}

static inline uint8_t
fits(int64_t value)
{
    return value == (int32_t)value;
}

/* Rounded to nearest. */
static inline int64_t
shifted(int64_t value, uint8_t bits)
{
    return bits ? (value + ((int64_t)1 << (bits - 1))) >> bits : value;
}

static uint8_t
apply_section(struct sos_section *s, uint8_t bits, int32_t x, int32_t *out)
{
    const int32_t *c = s->coefficient;
    int64_t y = shifted((int64_t)c[0] * x, bits) + s->state[0];
    if (!fits(y))
        return 0;
    int64_t first = shifted((int64_t)c[1] * x - (int64_t)c[3] * y, bits) + s->state[1];
    int64_t second = shifted((int64_t)c[2] * x - (int64_t)c[4] * y, bits);
    if (!fits(first) || !fits(second))
        return 0;
    s->state[0] = (int32_t)first;
    s->state[1] = (int32_t)second;
    *out = (int32_t)y;
    return 1;
}

uint8_t
sos_filter_apply(struct sos_filter *f, int32_t raw, int32_t *value)
{
    if (f->wants_offset) {
        f->offset = raw;
        f->wants_offset = 0;
    }
    int64_t difference = (int64_t)raw - f->offset;
    if (!fits(difference))
        return 0;
    int64_t scaled = shifted(difference * f->scale, f->scale_frac_bits);
    if (!fits(scaled))
        return 0;
    int32_t x = (int32_t)scaled;
    for (uint8_t i = 0; i < f->sections; i++)
        if (!apply_section(&f->section[i], f->coeff_frac_bits, x, &x))
            return 0;
    *value = x;
    return 1;
}

/* ---- commands ------------------------------------------------------------------------------ */

void
command_config_sos_filter(const struct command_args *args)
{
    uint8_t count = (uint8_t)args->val[1];
    uint16_t size = (uint16_t)(sizeof(struct sos_filter) + count * sizeof(struct sos_section));
    struct sos_filter *f = oid_alloc((uint8_t)args->val[0], &sos_filter_type, size);
    f->max_sections = count;
    f->scale = 1;
}
DECL_COMMAND(command_config_sos_filter, "config_sos_filter oid=%c max_sections=%c");

static struct sos_section *
section_of(const struct command_args *args)
{
    struct sos_filter *f = sos_filter_lookup((uint8_t)args->val[0]);
    if (args->val[1] >= f->max_sections)
        shutdown(SHUTDOWN_FILTER_SECTION);
    return &f->section[args->val[1]];
}

void
command_sos_filter_set_section(const struct command_args *args)
{
    struct sos_section *s = section_of(args);
    for (uint8_t i = 0; i < SECTION_COEFFICIENTS; i++)
        s->coefficient[i] = (int32_t)args->val[2 + i];
}
DECL_COMMAND(command_sos_filter_set_section,
             "sos_filter_set_section oid=%c section_idx=%c sos0=%i sos1=%i sos2=%i sos3=%i sos4=%i");

void
command_sos_filter_set_state(const struct command_args *args)
{
    struct sos_section *s = section_of(args);
    for (uint8_t i = 0; i < SECTION_STATES; i++)
        s->first_state[i] = s->state[i] = (int32_t)args->val[2 + i];
}
DECL_COMMAND(command_sos_filter_set_state, "sos_filter_set_state oid=%c section_idx=%c state0=%i state1=%i");

void
command_sos_filter_set_offset_scale(const struct command_args *args)
{
    struct sos_filter *f = sos_filter_lookup((uint8_t)args->val[0]);
    f->offset = (int32_t)args->val[1];
    f->scale = (int32_t)args->val[2];
    f->scale_frac_bits = args->val[3] & 31;
    f->auto_offset = f->wants_offset = !!args->val[4];
}
DECL_COMMAND(command_sos_filter_set_offset_scale,
             "sos_filter_set_offset_scale oid=%c offset=%i scale=%i scale_frac_bits=%c auto_offset=%c");

void
command_sos_filter_set_active(const struct command_args *args)
{
    struct sos_filter *f = sos_filter_lookup((uint8_t)args->val[0]);
    if (args->val[1] > f->max_sections)
        shutdown(SHUTDOWN_FILTER_SECTION);
    f->sections = (uint8_t)args->val[1];
    f->coeff_frac_bits = args->val[2] & 31;
    sos_filter_reset(f);
}
DECL_COMMAND(command_sos_filter_set_active, "sos_filter_set_active oid=%c n_sections=%c coeff_frac_bits=%c");
