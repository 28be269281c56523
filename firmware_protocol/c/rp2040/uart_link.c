/* UART 0 at 3 Mbaud on GPIO 0 and 1, polled: for boards whose USB serves something else. */

#include "hardware/gpio.h"
#include "hardware/uart.h"
#include "link.h"

void link_begin(const char *serial_number)
{
    (void)serial_number;
    uart_init(uart0, 3000000);
    gpio_set_function(0, GPIO_FUNC_UART);
    gpio_set_function(1, GPIO_FUNC_UART);
}

bool link_task(void)
{
    return false; /* a serial line does not show that a host begins */
}

uint32_t link_read(uint8_t *bytes, uint32_t room)
{
    uint32_t count = 0;
    while (count < room && uart_is_readable(uart0))
        bytes[count++] = (uint8_t)uart_get_hw(uart0)->dr;
    return count;
}

uint32_t link_write(const uint8_t *bytes, uint32_t size)
{
    uint32_t count = 0;
    while (count < size && uart_is_writable(uart0))
        uart_get_hw(uart0)->dr = bytes[count++];
    return count;
}

void link_flush(void)
{
}
