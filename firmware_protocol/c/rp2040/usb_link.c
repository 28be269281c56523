/* TinyUSB with a vendor and a CDC interface, of which the one serves on which bytes came last. */

#include "common/short_tail.h"
#include "link.h"
#include "tusb.h"
#include "usb_descriptors.h"

enum { BEGIN_REQUEST_TYPE = 0x41, BEGIN_REQUEST = 1, BEGIN_VERSION = 1 };

static bool vendor_serves, begun;
static struct short_tail tail;

void link_begin(const char *serial_number)
{
    usb_serial_number = serial_number;
    tusb_init();
}

static uint32_t write(void *context, const uint8_t *bytes, uint32_t size)
{
    (void)context;
    uint32_t room = vendor_serves ? tud_vendor_write_available() : tud_cdc_write_available();
    size = size < room ? size : room;
    if (size == 0)
        return 0;
    return vendor_serves ? tud_vendor_write(bytes, size) : tud_cdc_write(bytes, size);
}

static void serve(bool vendor)
{
    vendor_serves = vendor;
    tail.held = false;
    begun = true;
}

bool link_task(void)
{
    tud_task();
    bool begins = begun;
    begun = false;
    return begins;
}

/* BEGIN is the only request of this kind. What TinyUSB holds already, up to 256 bytes and a packet, still
   goes out before it: damage to the next host, which skips it. */
bool tud_vendor_control_xfer_cb(uint8_t rhport, uint8_t stage, tusb_control_request_t const *request)
{
    if (stage != CONTROL_STAGE_SETUP)
        return true;
    if (request->bmRequestType != BEGIN_REQUEST_TYPE || request->bRequest != BEGIN_REQUEST ||
        request->wValue != BEGIN_VERSION || request->wIndex != USB_VENDOR_INTERFACE || request->wLength != 0)
        return false; /* stalls */
    serve(true);
    return tud_control_status(rhport, request);
}

uint32_t link_read(uint8_t *bytes, uint32_t room)
{
    bool vendor = tud_vendor_available() > 0;
    if (!vendor && tud_cdc_available() == 0)
        return 0;
    if (vendor != vendor_serves) {
        serve(vendor); /* the bytes are read behind the begin */
        return 0;
    }
    return vendor ? tud_vendor_read(bytes, room) : tud_cdc_read(bytes, room);
}

uint32_t link_write(const uint8_t *bytes, uint32_t size)
{
    return short_tail_put(&tail, bytes, size, write, NULL);
}

void link_flush(void)
{
    bool empty = vendor_serves ? tud_vendor_write_available() == CFG_TUD_VENDOR_TX_BUFSIZE
                               : tud_cdc_write_available() == CFG_TUD_CDC_TX_BUFSIZE;
    if (empty)
        short_tail_release(&tail, write, NULL);
    if (vendor_serves)
        (void)tud_vendor_write_flush();
    else
        (void)tud_cdc_write_flush(); /* also while DTR is off */
}
