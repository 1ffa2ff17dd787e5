/* Runs the firmware in simavr: its UART is a pty, its outputs are lines on stdout.
 *
 *   simulate trigger.elf
 *
 * prints "pty PATH", then one line for every change of an output: "<cycle> <port letter> <pin> <level>". It ends when
 * stdin closes. The AVR runs at most SPEED times as fast as the real one.
 */

#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <signal.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define SLICE_CYCLES 16000 /* 1 ms of the AVR between two looks at the pty */
#define SPEED 8

static avr_t *avr;
static int master;
static int can_send = 1;

static void on_output(struct avr_irq_t *irq, uint32_t value, void *port_and_pin)
{
    const char *place = port_and_pin;
    (void)irq;
    printf("%llu %c %c %u\n", (unsigned long long)avr->cycle, place[0], place[1], (unsigned)value);
}

static void on_byte(struct avr_irq_t *irq, uint32_t value, void *context)
{
    char byte = value;
    (void)irq, (void)context;
    if (write(master, &byte, 1) != 1 && errno != EAGAIN)
        exit(1);
}

static void on_xon(struct avr_irq_t *irq, uint32_t value, void *context)
{
    (void)irq, (void)value, (void)context;
    can_send = 1;
}

static void on_xoff(struct avr_irq_t *irq, uint32_t value, void *context)
{
    (void)irq, (void)value, (void)context;
    can_send = 0;
}

/* simavr would sleep in real time while the AVR sleeps; the pace is held in main(). */
static void no_sleep(avr_t *unused, avr_cycle_count_t cycles)
{
    (void)unused, (void)cycles;
}

static void watch_outputs(void)
{
    static char places[24][2];
    int count = 0;
    for (const char *port = "BCD"; *port; port++)
        for (char pin = 0; pin < 8; pin++) {
            char *place = places[count++];
            place[0] = *port;
            place[1] = '0' + pin;
            avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(*port), pin), on_output, place);
        }
}

static void connect_uart(void)
{
    uint32_t flags = 0;
    avr_irq_t *uart = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), 0);
    avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
    flags &= ~(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP); /* no echo, no usleep in the UART */
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_register_notify(uart + UART_IRQ_OUTPUT, on_byte, 0);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XON, on_xon, 0);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XOFF, on_xoff, 0);
}

static void feed_uart(void)
{
    avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    unsigned char byte;
    while (can_send && read(master, &byte, 1) == 1)
        avr_raise_irq(input, byte);
}

static double now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + now.tv_nsec * 1e-9;
}

static void load(const char *path)
{
    elf_firmware_t firmware = {0};
    if (elf_read_firmware(path, &firmware) || !(avr = avr_make_mcu_by_name("atmega328p"))) {
        fprintf(stderr, "cannot load %s\n", path);
        exit(1);
    }
    avr_init(avr);
    firmware.frequency = 16000000;
    avr_load_firmware(avr, &firmware);
    avr->frequency = 16000000;
    avr->sleep = no_sleep;
}

int main(int argc, char **argv)
{
    char name[128];
    int slave;
    double started_s;
    if (argc != 2)
        return 2;
    load(argv[1]);
    struct termios raw;
    cfmakeraw(&raw);
    if (openpty(&master, &slave, name, &raw, 0))
        return 1;
    fcntl(master, F_SETFL, O_NONBLOCK);
    setvbuf(stdout, 0, _IOLBF, 0);
    watch_outputs();
    connect_uart();
    printf("pty %s\n", name);
    started_s = now_s();
    for (avr_cycle_count_t until = SLICE_CYCLES;; until += SLICE_CYCLES) {
        struct pollfd input = {.fd = 0, .events = POLLIN};
        char discard[64];
        feed_uart();
        while (avr->cycle < until) {
            int state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed)
                return 1;
        }
        double ahead_s = avr->cycle / 16e6 / SPEED - (now_s() - started_s);
        if (poll(&input, 1, ahead_s > 1e-4 ? 1 : 0) > 0 && read(0, discard, sizeof discard) <= 0)
            return 0;
    }
}
