/* Commands for testing a board by hand. */
#include "board/misc.h"
#include "command.h"

DECL_RESPONSE(response_pong, "pong data=%*s");
DECL_RESPONSE(response_debug_result, "debug_result val=%u");

void
command_debug_nop(const struct command_args *args)
{
    (void)args;
}
DECL_COMMAND_FLAGS(command_debug_nop, HF_IN_SHUTDOWN, "debug_nop");

void
command_debug_ping(const struct command_args *args)
{
    respond(&response_pong, (unsigned int)args->data_len, args->data);
}
DECL_COMMAND_FLAGS(command_debug_ping, HF_IN_SHUTDOWN, "debug_ping data=%*s");

void
command_debug_read(const struct command_args *args)
{
    respond(&response_debug_result, board_peek((uint8_t)args->val[0], args->val[1]));
}
DECL_COMMAND_FLAGS(command_debug_read, HF_IN_SHUTDOWN, "debug_read order=%c addr=%u");

void
command_debug_write(const struct command_args *args)
{
    board_poke((uint8_t)args->val[0], args->val[1], args->val[2]);
}
DECL_COMMAND_FLAGS(command_debug_write, HF_IN_SHUTDOWN, "debug_write order=%c addr=%u val=%u");
