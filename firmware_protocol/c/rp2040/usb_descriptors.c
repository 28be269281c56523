/* Descriptors: a composite device with the vendor interface of PROTOCOL.md, section 8, and a CDC ACM port.
 *
 * 1209:0001 is for tests alone; a product needs ids of its own (https://pid.codes gives some away).
 */

#include "usb_descriptors.h"

#include "tusb.h"

enum { VENDOR_ID = 0x1209, PRODUCT_ID = 0x0001 };
enum { LANGUAGE, MANUFACTURER, PRODUCT, SERIAL_NUMBER, CDC_PORT, VENDOR_PORT, STRINGS };
enum { TEXT_LENGTH_MAX = 63 };

const char *usb_serial_number;

static const tusb_desc_device_t device = {
    .bLength = sizeof(tusb_desc_device_t),
    .bDescriptorType = TUSB_DESC_DEVICE,
    .bcdUSB = 0x0200,
    .bDeviceClass = TUSB_CLASS_MISC, /* interface associations: two interfaces are one CDC function */
    .bDeviceSubClass = MISC_SUBCLASS_COMMON,
    .bDeviceProtocol = MISC_PROTOCOL_IAD,
    .bMaxPacketSize0 = CFG_TUD_ENDPOINT0_SIZE,
    .idVendor = VENDOR_ID,
    .idProduct = PRODUCT_ID,
    .bcdDevice = 0x0100,
    .iManufacturer = MANUFACTURER,
    .iProduct = PRODUCT,
    .iSerialNumber = SERIAL_NUMBER,
    .bNumConfigurations = 1,
};

/* The vendor interface byte by byte: its subclass and protocol are not those of TinyUSB's macro. */
enum { VENDOR_BYTES = 9 + 7 + 7, TOTAL_BYTES = TUD_CONFIG_DESC_LEN + TUD_CDC_DESC_LEN + VENDOR_BYTES };

static const uint8_t configuration[] = {
    TUD_CONFIG_DESCRIPTOR(1, USB_INTERFACES, 0, TOTAL_BYTES, 0, 100),
    TUD_CDC_DESCRIPTOR(USB_CDC_INTERFACE, CDC_PORT, 0x83, 8, 0x02, 0x82, 64),
    9, TUSB_DESC_INTERFACE, USB_VENDOR_INTERFACE, 0, 2, 0xFF, 0x52, 0x01, VENDOR_PORT,
    7, TUSB_DESC_ENDPOINT, 0x01, TUSB_XFER_BULK, U16_TO_U8S_LE(64), 0,
    7, TUSB_DESC_ENDPOINT, 0x81, TUSB_XFER_BULK, U16_TO_U8S_LE(64), 0,
};

uint8_t const *tud_descriptor_device_cb(void)
{
    return (uint8_t const *)&device;
}

uint8_t const *tud_descriptor_configuration_cb(uint8_t index)
{
    (void)index;
    return configuration;
}

uint16_t const *tud_descriptor_string_cb(uint8_t index, uint16_t language)
{
    static uint16_t text[1 + TEXT_LENGTH_MAX];
    static const char *const texts[STRINGS] = {
        [MANUFACTURER] = "resonator",
        [PRODUCT] = "resonator-rp2040",
        [CDC_PORT] = "resonator serial port",
        [VENDOR_PORT] = "resonator",
    };
    (void)language;
    uint32_t size = 0;
    if (index == LANGUAGE) {
        text[1] = 0x0409; /* English */
        size = 1;
    } else if (index < STRINGS) {
        const char *from = index == SERIAL_NUMBER ? usb_serial_number : texts[index];
        while (size < TEXT_LENGTH_MAX && from[size] != 0) {
            text[1 + size] = (uint8_t)from[size];
            size++;
        }
    } else {
        return NULL;
    }
    text[0] = (uint16_t)(TUSB_DESC_STRING << 8 | (2 * size + 2));
    return text;
}
