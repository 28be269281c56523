/* From reset to main: vectors, initial memory, and the two functions that compilers call on their own. */

#include "hardware.h"

#include <stddef.h>

extern uint32_t stack_top[], data_load[], data_start[], data_end[], bss_start[], bss_end[];

int main(void);
void reset_handler(void);

static void fault_handler(void)
{
    hardware_restart(RESTART_FAULT);
}

typedef void (*handler)(void);

/* The first 16 are the Cortex-M3's own, the others the board's interrupts. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler exceptions[15];
    handler interrupts[32];
} vectors = {
    .stack = stack_top,
    .exceptions = {
        [0] = reset_handler,
        [1] = fault_handler,  /* NMI */
        [2] = fault_handler,  /* hard fault */
        [3] = fault_handler,  /* memory management */
        [4] = fault_handler,  /* bus fault */
        [5] = fault_handler,  /* usage fault */
        [10] = fault_handler, /* supervisor call */
        [11] = fault_handler, /* debug monitor */
        [13] = fault_handler, /* PendSV */
        [14] = systick_handler,
    },
    .interrupts = {
        [UART0_RECEIVE_INTERRUPT] = uart_receive_handler,
        [UART0_TRANSMIT_INTERRUPT] = uart_transmit_handler,
    },
};

void reset_handler(void)
{
    const uint32_t *from = data_load;
    for (uint32_t *to = data_start; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_start; to < bss_end; to++)
        *to = 0;
    main();
    hardware_restart(RESTART_FAULT);
}

void *memcpy(void *to, const void *from, size_t bytes);
void *memset(void *to, int value, size_t bytes);

void *memcpy(void *to, const void *from, size_t bytes)
{
    unsigned char *target = to;
    const unsigned char *source = from;
    while (bytes-- > 0)
        *target++ = *source++;
    return to;
}

void *memset(void *to, int value, size_t bytes)
{
    unsigned char *target = to;
    while (bytes-- > 0)
        *target++ = (unsigned char)value;
    return to;
}
