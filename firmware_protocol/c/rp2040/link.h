/* The way to the host: USB (usb_link.c) or UART 0 (uart_link.c). */
#ifndef RP2040_LINK_H
#define RP2040_LINK_H

#include <stdbool.h>
#include <stdint.h>

/* Begin; `serial_number` stays in place. */
void link_begin(const char *serial_number);

/* Do what the link has to do by itself. Return whether a host begins afresh: resonator_begin is due. */
bool link_task(void);

/* Read up to `room` received bytes. Return how many. */
uint32_t link_read(uint8_t *bytes, uint32_t room);

/* Accept up to `size` bytes to send. Return how many. */
uint32_t link_write(const uint8_t *bytes, uint32_t size);

/* Nothing more is to be sent for now. */
void link_flush(void);

#endif
