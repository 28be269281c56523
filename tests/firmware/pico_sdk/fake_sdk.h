/* What rp2040/capture.c uses of the Pico SDK, with memory in place of the hardware: for tests on a computer. */
#ifndef FAKE_SDK_H
#define FAKE_SDK_H

#include <stdbool.h>
#include <stdint.h>

typedef unsigned int uint;

typedef struct {
    uint chain_to, ring_bits;
} dma_channel_config_t;

enum { DMA_SIZE_32 = 2, FAKE_DMA_CHANNELS = 12 };

struct fake_dma {
    struct {
        uint32_t transfer_count, al1_transfer_count_trig;
    } ch[FAKE_DMA_CHANNELS];
};

struct fake_pio {
    uint32_t fdebug, rxf[4];
};

struct fake_pwm {
    uint32_t intr;
};

extern struct fake_dma fake_dma;
extern struct fake_pio fake_pio;
extern struct fake_pwm fake_pwm;
#define dma_hw (&fake_dma)
#define pio0 (&fake_pio)
#define pwm_hw (&fake_pwm)

static inline dma_channel_config_t dma_channel_get_default_config(uint channel)
{
    dma_channel_config_t settings = {channel, 0};
    return settings;
}

static inline void channel_config_set_transfer_data_size(dma_channel_config_t *c, int size) { (void)c, (void)size; }
static inline void channel_config_set_read_increment(dma_channel_config_t *c, bool on) { (void)c, (void)on; }
static inline void channel_config_set_write_increment(dma_channel_config_t *c, bool on) { (void)c, (void)on; }
static inline void channel_config_set_ring(dma_channel_config_t *c, bool write, uint bits) { (void)write, c->ring_bits = bits; }
static inline void channel_config_set_dreq(dma_channel_config_t *c, uint dreq) { (void)c, (void)dreq; }
static inline void channel_config_set_chain_to(dma_channel_config_t *c, uint channel) { c->chain_to = channel; }
static inline void channel_config_set_high_priority(dma_channel_config_t *c, bool on) { (void)c, (void)on; }
static inline void dma_channel_abort(uint channel) { (void)channel; }
void dma_channel_configure(uint channel, const dma_channel_config_t *config, volatile void *to, const volatile void *from,
                           uint32_t count, bool trigger);
int dma_claim_unused_channel(bool required);

typedef struct {
    uint jmp_pin;
} pio_sm_config;

typedef struct {
    int words;
} pio_program_t;

enum pio_src_dest { pio_x = 1, pio_y = 2, pio_osr = 7 };
enum { PIO_FDEBUG_RXSTALL_LSB = 0, capture_offset_low = 6 };
static const pio_program_t capture_program = {8};

static inline pio_sm_config capture_program_get_default_config(uint offset)
{
    pio_sm_config settings = {offset};
    return settings;
}

static inline void sm_config_set_jmp_pin(pio_sm_config *c, uint pin) { c->jmp_pin = pin; }
static inline uint pio_get_dreq(struct fake_pio *pio, uint sm, bool is_tx) { (void)pio, (void)is_tx; return sm; }
static inline int pio_add_program(struct fake_pio *pio, const pio_program_t *program) { (void)pio; return program->words; }
static inline void pio_set_sm_mask_enabled(struct fake_pio *pio, uint32_t mask, bool on) { (void)pio, (void)mask, (void)on; }
static inline void pio_sm_init(struct fake_pio *pio, uint sm, uint pc, const pio_sm_config *c) { (void)pio, (void)sm, (void)pc, (void)c; }
static inline uint pio_encode_pull(bool if_empty, bool block) { (void)if_empty, (void)block; return 0x8080; }
static inline uint pio_encode_mov(enum pio_src_dest to, enum pio_src_dest from) { return 0xA000u | (uint)to << 5 | (uint)from; }
void pio_sm_put(struct fake_pio *pio, uint sm, uint32_t data);
void pio_sm_exec(struct fake_pio *pio, uint sm, uint instruction);
void pio_enable_sm_mask_in_sync(struct fake_pio *pio, uint32_t mask);

typedef struct {
    uint wrap;
} pwm_config;

enum { PWM_IRQ_WRAP = 4 };
#define PWM_DEFAULT_IRQ_NUM() PWM_IRQ_WRAP
static inline pwm_config pwm_get_default_config(void)
{
    pwm_config settings = {0};
    return settings;
}

static inline void pwm_config_set_clkdiv_int(pwm_config *c, uint by) { (void)c, (void)by; }
static inline void pwm_config_set_wrap(pwm_config *c, uint16_t wrap) { c->wrap = wrap; }
static inline void pwm_init(uint slice, pwm_config *c, bool start) { (void)slice, (void)c, (void)start; }
static inline void pwm_clear_irq(uint slice) { pwm_hw->intr &= ~(1u << slice); }
static inline void pwm_set_irq_enabled(uint slice, bool on) { (void)slice, (void)on; }
static inline void pwm_set_enabled(uint slice, bool on) { (void)slice, (void)on; }
uint16_t pwm_get_counter(uint slice);
static inline void irq_set_exclusive_handler(uint number, void (*handler)(void)) { (void)number, (void)handler; }
static inline void irq_set_enabled(uint number, bool on) { (void)number, (void)on; }
static inline void gpio_init(uint pin) { (void)pin; }
static inline uint32_t save_and_disable_interrupts(void) { return 0; }
static inline void restore_interrupts(uint32_t before) { (void)before; }

#endif
