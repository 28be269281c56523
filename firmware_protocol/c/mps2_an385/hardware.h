/* What the board program uses of the MPS2-AN385: one UART, one timer, one LED, and how it started. */

#ifndef HARDWARE_H
#define HARDWARE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { UART0_RECEIVE_INTERRUPT = 0, UART0_TRANSMIT_INTERRUPT = 1 };

/* The timer counts at 25 MHz. A counter of real tones has a faster reference; this one's is taken to be 1 GHz, as the
   plate file says, and its ticks are counts times 40. So ticks are true to the timer, and only every 40th occurs. */
enum { COUNTS_HZ = 25000000, TICKS_PER_COUNT = 40 };

enum restart { RESTART_POWER_ON, RESTART_PIN, RESTART_FAULT };

struct hardware_start {
    uint32_t boot_id; /* another one at each start, never 0 */
    enum restart cause;
};

/* Begin: UART, timer, a wake-up each millisecond. Call once, first. */
struct hardware_start hardware_begin(void);

/* Start the whole board again. */
void hardware_restart(enum restart cause) __attribute__((noreturn));

/* Ticks since the start. Call it from the main loop alone, and more often than the timer wraps (171 s). */
uint64_t hardware_ticks(void);

/* Read up to `room` received bytes; `ticks` becomes the time at which the last of them came. Returns how many. */
size_t uart_read(uint8_t *bytes, size_t room, uint64_t *ticks);

/* Send as many bytes as the UART accepts at once; never waits. Returns how many. */
size_t uart_send(const uint8_t *bytes, size_t count);

/* Sleep until an interrupt, at most a millisecond; returns at once while received bytes wait. */
void hardware_sleep(void);

void led_set(bool on);

void systick_handler(void);
void uart_receive_handler(void);
void uart_transmit_handler(void);

#endif
