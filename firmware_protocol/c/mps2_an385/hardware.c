/* Drivers of the MPS2-AN385: CMSDK UART 0 and timer 0, SysTick, LED 0. Addresses are those of Arm's note AN385. */

#include "hardware.h"

#include "common/receive_ring.h"

struct uart {
    volatile uint32_t data, state, control, interrupts, baud_divider;
};

struct timer {
    volatile uint32_t control, value, reload, interrupts;
};

struct systick {
    volatile uint32_t control, reload, value;
};

#define UART0 ((struct uart *)0x40004000u)
#define TIMER0 ((struct timer *)0x40000000u)
#define SYSTICK ((struct systick *)0xE000E010u)
#define INTERRUPT_ENABLE (*(volatile uint32_t *)0xE000E100u)
#define RESET_CONTROL (*(volatile uint32_t *)0xE000ED0Cu)
#define LEDS (*(volatile uint32_t *)0x40028000u)

enum { TRANSMIT_FULL = 1u, RECEIVE_FULL = 2u };                                  /* state */
enum { TRANSMIT_ENABLE = 1u, RECEIVE_ENABLE = 2u, TRANSMIT_INTERRUPT = 4u, RECEIVE_INTERRUPT = 8u }; /* control */
enum { TRANSMIT_PENDING = 1u, RECEIVE_PENDING = 2u };                            /* interrupts */
enum { SYSTICK_ENABLE = 1u, SYSTICK_INTERRUPT = 2u, SYSTICK_CORE_CLOCK = 4u };
enum { RESET_KEY_AND_REQUEST = 0x05FA0004u };

/* Memory that a reset leaves alone; see link.ld. `mark` distinguishes it from what is in RAM after power on. */
struct kept {
    uint32_t mark, starts, cause, random;
};

extern volatile struct kept kept;
static const uint32_t kept_mark = 0x52444B50u;

/* Each byte with the timer's count then: the answer to a PING carries the time at which the PING came, not when the
   main loop had time for it. */
static struct receive_ring received;
static uint64_t counts;
static uint32_t counts_seen;

static uint32_t timer_counts(void)
{
    return ~TIMER0->value; /* it counts down */
}

static struct hardware_start start_anew(void)
{
    struct hardware_start start = {.cause = RESTART_POWER_ON};
    if (kept.mark == kept_mark) {
        kept.starts++;
        start.cause = (enum restart)kept.cause;
    } else {
        kept.mark = kept_mark;
        kept.starts = 0;
    }
    kept.cause = RESTART_PIN; /* unless this program restarts itself */
    start.boot_id = kept.random + kept.starts;
    if (start.boot_id == 0)
        start.boot_id = kept_mark;
    return start;
}

struct hardware_start hardware_begin(void)
{
    TIMER0->control = 0;
    TIMER0->reload = 0xFFFFFFFFu;
    TIMER0->value = 0xFFFFFFFFu;
    TIMER0->control = 1;
    counts_seen = timer_counts();

    UART0->baud_divider = 16; /* the fastest; the emulated UART is as fast as its other end */
    UART0->control = TRANSMIT_ENABLE | RECEIVE_ENABLE | RECEIVE_INTERRUPT;
    INTERRUPT_ENABLE = 1u << UART0_RECEIVE_INTERRUPT | 1u << UART0_TRANSMIT_INTERRUPT;

    SYSTICK->reload = COUNTS_HZ / 1000 - 1;
    SYSTICK->value = 0;
    SYSTICK->control = SYSTICK_ENABLE | SYSTICK_INTERRUPT | SYSTICK_CORE_CLOCK;
    return start_anew();
}

void hardware_restart(enum restart cause)
{
    kept.cause = cause;
    __asm__ volatile("dsb");
    RESET_CONTROL = RESET_KEY_AND_REQUEST;
    for (;;)
        ;
}

uint64_t hardware_ticks(void)
{
    uint32_t now = timer_counts();
    counts += (uint32_t)(now - counts_seen); /* also across the timer's wrap */
    counts_seen = now;
    return counts * TICKS_PER_COUNT;
}

/* Wakes the main loop and no more: frames go by the timer, so a late or lost interrupt delays one and shifts none. */
void systick_handler(void)
{
}

void uart_receive_handler(void)
{
    UART0->interrupts = RECEIVE_PENDING;
    while (UART0->state & RECEIVE_FULL)
        (void)receive_ring_write(&received, (uint8_t)UART0->data, timer_counts());
}

size_t uart_read(uint8_t *bytes, size_t room, uint64_t *ticks)
{
    uint32_t last = 0;
    size_t count = receive_ring_read(&received, bytes, room, &last);
    *ticks = hardware_ticks();
    if (count > 0)
        *ticks -= (uint64_t)(uint32_t)(counts_seen - last) * TICKS_PER_COUNT;
    return count;
}

size_t uart_send(const uint8_t *bytes, size_t count)
{
    size_t sent = 0;
    while (sent < count && !(UART0->state & TRANSMIT_FULL))
        UART0->data = bytes[sent++];
    if (sent < count)
        UART0->control |= TRANSMIT_INTERRUPT; /* wakes the main loop when there is room again */
    return sent;
}

void uart_transmit_handler(void)
{
    UART0->control &= ~(uint32_t)TRANSMIT_INTERRUPT; /* once: not at every byte */
    UART0->interrupts = TRANSMIT_PENDING;
}

void hardware_sleep(void)
{
    /* An interrupt that comes after the look wakes the processor all the same, and is served behind it. */
    __asm__ volatile("cpsid i" ::: "memory");
    if (receive_ring_empty(&received))
        __asm__ volatile("wfi");
    __asm__ volatile("cpsie i" ::: "memory");
}

void led_set(bool on)
{
    LEDS = on ? 1u : 0u;
}
