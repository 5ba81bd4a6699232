/* Hardware PWM outputs. */
#include "basecmd.h"
#include "board/pwm.h"
#include "command.h"
#include "sched.h"
#include "timed_output.h"

struct hardware_pwm {
    struct timed_output output;
    struct pwm_out pin;
    uint32_t default_value;
};

static uint8_t
pwm_apply(struct timed_output *o, uint32_t value)
{
    struct hardware_pwm *p = container_of(o, struct hardware_pwm, output);
    pwm_write(p->pin, value);
    return value == p->default_value;
}

static const struct timed_output_kind pwm_kind = {
    .apply = pwm_apply,
    .missed_reason = SHUTDOWN_PWM_MISSED,
    .exceed_reason = SHUTDOWN_PWM_EXCEED,
};

void
command_config_pwm_out(const struct command_args *args)
{
    struct hardware_pwm *p = oid_alloc((uint8_t)args->val[0], command_config_pwm_out, sizeof(*p));
    uint32_t value = args->val[3] & 0xffff;
    p->default_value = args->val[4] & 0xffff;
    p->pin = pwm_setup(args->val[1], args->val[2], value);
    timed_output_init(&p->output, &pwm_kind, args->val[5]);
    timed_output_set_now(&p->output, value);
}
DECL_COMMAND(command_config_pwm_out,
             "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u");

void
command_queue_pwm_out(const struct command_args *args)
{
    struct hardware_pwm *p = oid_lookup((uint8_t)args->val[0], command_config_pwm_out);
    timed_output_queue(&p->output, args->val[1], args->val[2] & 0xffff);
}
DECL_COMMAND(command_queue_pwm_out, "queue_pwm_out oid=%c clock=%u value=%hu");

void
command_set_pwm_out(const struct command_args *args)
{
    pwm_setup(args->val[0], args->val[1], args->val[2] & 0xffff);
}
DECL_COMMAND(command_set_pwm_out, "set_pwm_out pin=%u cycle_ticks=%u value=%hu");

void
pwm_shutdown(void)
{
    uint8_t i;
    struct hardware_pwm *p;
    foreach_oid(i, p, command_config_pwm_out) {
        timed_output_shutdown(&p->output);
        pwm_write(p->pin, p->default_value);
    }
}
DECL_SHUTDOWN(pwm_shutdown);
