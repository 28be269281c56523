/* What the board program uses of an STM32F405 or F407 besides the capture: clocks, a serial line, a LED, how it started. */
#ifndef STM32F4_HARDWARE_H
#define STM32F4_HARDWARE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Set the clocks: 168 MHz out of a crystal of 8 MHz. False: the crystal does not oscillate, all runs on 16 MHz. */
bool hardware_begin(void);

/* Return a random boot id, never 0. */
uint32_t hardware_boot_id(void);

/* Return the reset cause as enum resonator_reset_cause, and clear it. */
uint8_t hardware_reset_cause(void);

/* Start the whole board again. */
void hardware_restart(void) __attribute__((noreturn));

/* Open the serial line, USART3: PD8 sends, PD9 receives, 3 Mbaud with clocks of 168 MHz. */
void serial_begin(void);

/* Read up to `room` received bytes; `ticks` becomes the time at which the last of them came. Return how many. */
size_t serial_read(uint8_t *bytes, size_t room, uint64_t *ticks);

/* Begin to send `size` bytes, which stay in place. */
void serial_send(const uint8_t *bytes, uint16_t size);

/* Whether nothing is being sent. */
bool serial_idle(void);

/* Switch the LED at PD12. */
void led_set(bool on);

void serial_receive_handler(void);

#endif
