/* Runs rp2040/usb_link.c on a computer, with TinyUSB's functions as buffers, by commands on standard input: for tests.
 *
 *   descriptors                        prints the configuration descriptor and the serial number's string, in hex
 *   begin TYPE REQUEST VALUE INDEX LENGTH   a control request in its setup stage: prints "done" or "stalled"
 *   vendor HEX | cdc HEX               bytes come from the host
 *   task                               prints 1 where a host begins afresh
 *   read                               prints what link_read returns, until it returns nothing
 *   write HEX                          prints how many bytes are accepted
 *   flush                              prints what has left for the host by now, per interface
 */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "link.h"
#include "tusb.h"
#include "usb_descriptors.h"

struct pipe {
    uint8_t in[4096];
    uint32_t in_bytes;
    uint8_t out[256], sent[8192];
    uint32_t out_bytes, sent_bytes;
};

static struct pipe vendor, cdc;

static uint32_t read_from(struct pipe *pipe, void *buffer, uint32_t size)
{
    size = size < pipe->in_bytes ? size : pipe->in_bytes;
    memcpy(buffer, pipe->in, size);
    memmove(pipe->in, pipe->in + size, pipe->in_bytes - size);
    pipe->in_bytes -= size;
    return size;
}

static uint32_t put_into(struct pipe *pipe, void const *buffer, uint32_t size)
{
    memcpy(pipe->out + pipe->out_bytes, buffer, size);
    pipe->out_bytes += size;
    return size;
}

static uint32_t leave(struct pipe *pipe)
{
    uint32_t size = pipe->out_bytes;
    memcpy(pipe->sent + pipe->sent_bytes, pipe->out, size);
    pipe->sent_bytes += size;
    pipe->out_bytes = 0;
    return size;
}

bool tusb_init(void)
{
    return true;
}

void tud_task(void)
{
}

bool tud_control_status(uint8_t rhport, tusb_control_request_t const *request)
{
    (void)rhport;
    (void)request;
    return true;
}

uint32_t tud_vendor_available(void) { return vendor.in_bytes; }
uint32_t tud_vendor_read(void *buffer, uint32_t bufsize) { return read_from(&vendor, buffer, bufsize); }
uint32_t tud_vendor_write(void const *buffer, uint32_t bufsize) { return put_into(&vendor, buffer, bufsize); }
uint32_t tud_vendor_write_flush(void) { return leave(&vendor); }
uint32_t tud_vendor_write_available(void) { return (uint32_t)sizeof vendor.out - vendor.out_bytes; }
uint32_t tud_cdc_available(void) { return cdc.in_bytes; }
uint32_t tud_cdc_read(void *buffer, uint32_t bufsize) { return read_from(&cdc, buffer, bufsize); }
uint32_t tud_cdc_write(void const *buffer, uint32_t bufsize) { return put_into(&cdc, buffer, bufsize); }
uint32_t tud_cdc_write_flush(void) { return leave(&cdc); }
uint32_t tud_cdc_write_available(void) { return (uint32_t)sizeof cdc.out - cdc.out_bytes; }

static uint32_t bytes_of(const char *hex, uint8_t *into)
{
    uint32_t size = (uint32_t)strlen(hex) / 2;
    for (uint32_t i = 0; i < size; i++) {
        char pair[3] = {hex[2 * i], hex[2 * i + 1], 0};
        into[i] = (uint8_t)strtoul(pair, NULL, 16);
    }
    return size;
}

static void print_hex(const char *name, const uint8_t *bytes, uint32_t size)
{
    printf("%s ", name);
    for (uint32_t i = 0; i < size; i++)
        printf("%02x", bytes[i]);
    printf("\n");
}

int main(void)
{
    static char line[20000], words[6][20000];
    static uint8_t bytes[8192];
    link_begin("A1B2");
    while (fgets(line, sizeof line, stdin) != NULL) {
        int count = sscanf(line, "%19999s %19999s %19999s %19999s %19999s %19999s", words[0], words[1], words[2], words[3],
                           words[4], words[5]);
        if (strcmp(words[0], "descriptors") == 0) {
            const uint8_t *configuration = tud_descriptor_configuration_cb(0);
            const uint16_t *text = tud_descriptor_string_cb(3, 0x0409);
            print_hex("configuration", configuration, (uint32_t)(configuration[2] | configuration[3] << 8));
            print_hex("serial", (const uint8_t *)text, text[0] & 0xFFu);
        } else if (strcmp(words[0], "begin") == 0 && count == 6) {
            tusb_control_request_t request = {(uint8_t)atoi(words[1]), (uint8_t)atoi(words[2]), (uint16_t)atoi(words[3]),
                                              (uint16_t)atoi(words[4]), (uint16_t)atoi(words[5])};
            printf(tud_vendor_control_xfer_cb(0, CONTROL_STAGE_SETUP, &request) ? "done\n" : "stalled\n");
        } else if (strcmp(words[0], "vendor") == 0) {
            vendor.in_bytes += bytes_of(words[1], vendor.in + vendor.in_bytes);
        } else if (strcmp(words[0], "cdc") == 0) {
            cdc.in_bytes += bytes_of(words[1], cdc.in + cdc.in_bytes);
        } else if (strcmp(words[0], "task") == 0) {
            printf("%d\n", link_task());
        } else if (strcmp(words[0], "read") == 0) {
            uint32_t size = link_read(bytes, sizeof bytes);
            print_hex("read", bytes, size);
        } else if (strcmp(words[0], "write") == 0) {
            printf("%u\n", (unsigned)link_write(bytes, bytes_of(words[1], bytes)));
        } else {
            link_flush();
            link_flush(); /* by now the buffer was empty, and the last byte went */
            print_hex("vendor", vendor.sent, vendor.sent_bytes);
            print_hex("cdc", cdc.sent, cdc.sent_bytes);
            vendor.sent_bytes = cdc.sent_bytes = 0;
        }
    }
    return 0;
}
