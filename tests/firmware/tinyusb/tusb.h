/* What the RP2040 board uses of TinyUSB, declared and not defined: for compiling without TinyUSB. The signatures are those
 * of TinyUSB 0.18 to 0.20 (src/class/vendor/vendor_device.h, src/class/cdc/cdc_device.h, src/device/usbd.h).
 */
#ifndef TUSB_H
#define TUSB_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { OPT_MODE_DEVICE = 1 };

#include "tusb_config.h"

enum { CONTROL_STAGE_IDLE, CONTROL_STAGE_SETUP, CONTROL_STAGE_DATA, CONTROL_STAGE_ACK };
enum { TUSB_DESC_DEVICE = 1, TUSB_DESC_CONFIGURATION, TUSB_DESC_STRING, TUSB_DESC_INTERFACE, TUSB_DESC_ENDPOINT };
enum { TUSB_CLASS_MISC = 0xEF, MISC_SUBCLASS_COMMON = 2, MISC_PROTOCOL_IAD = 1, TUSB_XFER_BULK = 2 };

typedef struct __attribute__((packed)) {
    uint8_t bLength, bDescriptorType;
    uint16_t bcdUSB;
    uint8_t bDeviceClass, bDeviceSubClass, bDeviceProtocol, bMaxPacketSize0;
    uint16_t idVendor, idProduct, bcdDevice;
    uint8_t iManufacturer, iProduct, iSerialNumber, bNumConfigurations;
} tusb_desc_device_t;

typedef struct __attribute__((packed)) {
    uint8_t bmRequestType, bRequest;
    uint16_t wValue, wIndex, wLength;
} tusb_control_request_t;

#define U16_TO_U8S_LE(value) (uint8_t)((value)&0xFF), (uint8_t)((value) >> 8)
#define TUD_CONFIG_DESC_LEN 9
#define TUD_CONFIG_DESCRIPTOR(number, interfaces, text, bytes, attributes, milliampere)                                \
    9, TUSB_DESC_CONFIGURATION, U16_TO_U8S_LE(bytes), interfaces, number, text, 0x80 | (attributes), (milliampere) / 2
#define TUD_CDC_DESC_LEN (8 + 9 + 5 + 5 + 4 + 5 + 7 + 9 + 7 + 7)
#define TUD_CDC_DESCRIPTOR(interface, text, notify, notify_bytes, out, in, bytes)                                      \
    8, 11, interface, 2, 2, 2, 0, 0, 9, TUSB_DESC_INTERFACE, interface, 0, 1, 2, 2, 0, text, 5, 0x24, 0, 0x20, 1, 5,    \
        0x24, 1, 0, (interface) + 1, 4, 0x24, 2, 6, 5, 0x24, 6, interface, (interface) + 1, 7, TUSB_DESC_ENDPOINT,      \
        notify, 3, U16_TO_U8S_LE(notify_bytes), 16, 9, TUSB_DESC_INTERFACE, (interface) + 1, 0, 2, 10, 0, 0, 0, 7,      \
        TUSB_DESC_ENDPOINT, out, TUSB_XFER_BULK, U16_TO_U8S_LE(bytes), 0, 7, TUSB_DESC_ENDPOINT, in, TUSB_XFER_BULK,    \
        U16_TO_U8S_LE(bytes), 0

bool tusb_init(void);
void tud_task(void);
bool tud_control_status(uint8_t rhport, tusb_control_request_t const *request);

uint32_t tud_vendor_available(void);
uint32_t tud_vendor_read(void *buffer, uint32_t bufsize);
uint32_t tud_vendor_write(void const *buffer, uint32_t bufsize);
uint32_t tud_vendor_write_flush(void);
uint32_t tud_vendor_write_available(void);

uint32_t tud_cdc_available(void);
uint32_t tud_cdc_read(void *buffer, uint32_t bufsize);
uint32_t tud_cdc_write(void const *buffer, uint32_t bufsize);
uint32_t tud_cdc_write_flush(void);
uint32_t tud_cdc_write_available(void);

/* Defined by the board. */
bool tud_vendor_control_xfer_cb(uint8_t rhport, uint8_t stage, tusb_control_request_t const *request);
uint8_t const *tud_descriptor_device_cb(void);
uint8_t const *tud_descriptor_configuration_cb(uint8_t index);
uint16_t const *tud_descriptor_string_cb(uint8_t index, uint16_t langid);

#endif
