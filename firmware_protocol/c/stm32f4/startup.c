/* From reset to main: vectors, initial memory, and the two functions that compilers call on their own. */

#include <stddef.h>
#include <stdint.h>

#include "hardware.h"
#include "registers.h"

extern uint32_t stack_top[], data_load[], data_start[], data_end[], bss_start[], bss_end[];

int main(void);
void reset_handler(void);

static void fault_handler(void)
{
    hardware_restart();
}

typedef void (*handler)(void);

/* 16 of the core, 82 of the chip (RM0090, vector table of the F405/407). An interrupt that is not enabled needs no handler. */
__attribute__((section(".vectors"), used)) static const struct {
    uint32_t *stack;
    handler exceptions[15];
    handler interrupts[82];
} vectors = {
    .stack = stack_top,
    .exceptions = {reset_handler, fault_handler, fault_handler, fault_handler, fault_handler, fault_handler},
    .interrupts = {[USART3_INTERRUPT] = serial_receive_handler},
};

void reset_handler(void)
{
    const uint32_t *from = data_load;
    for (uint32_t *to = data_start; to < data_end; to++)
        *to = *from++;
    for (uint32_t *to = bss_start; to < bss_end; to++)
        *to = 0;
    main();
    hardware_restart();
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
