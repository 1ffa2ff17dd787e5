/* Firmware of the trigger box for an ATmega328P at 16 MHz (Arduino Uno, Nano): docs/rig.md.
 *
 * Camera outputs 0..5 are PD2..PD7 (Arduino D2..D7), 6..11 are PB0..PB5 (D8..D13); light outputs 0..3 are
 * PC0..PC3 (A0..A3). All are active high. UART0 runs at 115200 baud, 8N1.
 *
 * Timer 1 counts half microseconds and never stops: it is the box's clock. Timer 2 ticks every 50 us while a release
 * is under way and raises and lowers the outputs. The interrupt of the UART only stores bytes; lines are cut, checked
 * and acted on in the main loop, which sleeps in between. A watchdog resets a box that hangs: all outputs then fall.
 */

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/sleep.h>
#include <avr/wdt.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <util/atomic.h>
#define BAUD_TOL 3 /* 16 MHz gives 117,647 baud, 2.1 % fast: a start bit resynchronises every 10 bits */
#include <util/setbaud.h>

#ifndef BOX_ID
#define BOX_ID "0"
#endif
#define STRING_OF(x) #x
#define STRING(x) STRING_OF(x)

#define CHANNELS 12
#define LIGHTS 4
#define LINE_MOST 80 /* bytes between the start character and the newline */
#define BODY_MOST (LINE_MOST - 8) /* without "SS " and "*CCCC" */
#define TICK_US 50
#define DELAY_MOST_US 500000UL
#define PULSE_MOST_US 500000UL
#define WINDOW_MOST_MS 60000UL
#define RING 128 /* received bytes, a power of two: 11 ms at full speed */

static volatile uint8_t ring[RING];
static volatile uint8_t ring_head, ring_tail;
static volatile uint8_t line_broken; /* framing error or overrun since the main loop last looked */

static volatile uint32_t clock_high; /* overflows of timer 1 */

static uint16_t delay_ticks[CHANNELS];
static volatile uint16_t fire_mask, fire_tick, fire_last, pulse_ticks;
static volatile uint8_t firing;

static uint8_t armed;
static uint32_t armed_at_us, window_us;
static uint16_t shots;
static uint8_t lights;
static uint16_t bad_lines;

static char line[LINE_MOST];
static uint8_t line_length, in_line;

static char reply[BODY_MOST];
static uint8_t reply_length;
static uint8_t last_valid, last_sequence;
static uint16_t last_checksum;

ISR(USART_RX_vect)
{
    uint8_t broken = UCSR0A & (_BV(FE0) | _BV(DOR0)); /* must be read before the byte */
    uint8_t byte = UDR0;
    uint8_t next = (ring_head + 1) & (RING - 1);
    if (broken || next == ring_tail) {
        line_broken = 1;
        return;
    }
    ring[ring_head] = byte;
    ring_head = next;
}

ISR(TIMER1_OVF_vect)
{
    clock_high++;
}

/* The outputs that are high in ``mask``, the others low. */
static void set_channels(uint16_t mask)
{
    PORTD = (PORTD & 0x03) | (uint8_t)((mask & 0x3F) << 2);
    PORTB = (PORTB & 0xC0) | (uint8_t)((mask >> 6) & 0x3F);
}

/* Raises what is due at ``tick`` and lowers what has been high for the pulse. */
static void release_tick(uint16_t tick)
{
    uint16_t high = 0;
    for (uint8_t channel = 0; channel < CHANNELS; channel++) {
        uint16_t since = tick - delay_ticks[channel];
        if (tick >= delay_ticks[channel] && since < pulse_ticks)
            high |= (uint16_t)1 << channel;
    }
    set_channels(high & fire_mask);
}

ISR(TIMER2_COMPA_vect)
{
    uint16_t tick = ++fire_tick;
    release_tick(tick);
    if (tick >= fire_last) {
        TCCR2B = 0;
        set_channels(0);
        firing = 0;
    }
}

/* Microseconds since power-up, modulo 2^32. */
static uint32_t clock_us(void)
{
    uint16_t low;
    uint32_t high;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        low = TCNT1;
        high = clock_high;
        /* an overflow that has not been served yet belongs to a small ``low`` */
        if ((TIFR1 & _BV(TOV1)) && low < 0x8000)
            high++;
    }
    return high << 15 | low >> 1;
}

/* CRC-16/CCITT-FALSE, one byte further. */
static uint16_t crc_step(uint16_t crc, uint8_t byte)
{
    crc ^= (uint16_t)byte << 8;
    for (uint8_t bit = 0; bit < 8; bit++)
        crc = crc & 0x8000 ? (crc << 1) ^ 0x1021 : crc << 1;
    return crc;
}

static void send(char byte)
{
    loop_until_bit_is_set(UCSR0A, UDRE0);
    UDR0 = byte;
}

static char hex_digit(uint8_t value)
{
    return value < 10 ? '0' + value : 'A' + value - 10;
}

static void put_text(const char *text) /* in flash */
{
    char byte;
    while ((byte = pgm_read_byte(text++)) && reply_length < BODY_MOST)
        reply[reply_length++] = byte;
}

static void put_number(uint32_t number, uint8_t radix)
{
    char digits[11];
    ultoa(number, digits, radix);
    for (char *digit = digits; *digit && reply_length < BODY_MOST; digit++)
        reply[reply_length++] = *digit >= 'a' ? *digit - 'a' + 'A' : *digit;
}

static uint16_t send_counted(uint16_t crc, char byte)
{
    send(byte);
    return crc_step(crc, byte);
}

static void send_reply(uint8_t sequence)
{
    uint16_t crc = 0xFFFF;
    send('#');
    crc = send_counted(crc, hex_digit(sequence >> 4));
    crc = send_counted(crc, hex_digit(sequence & 15));
    crc = send_counted(crc, ' ');
    for (uint8_t i = 0; i < reply_length; i++)
        crc = send_counted(crc, reply[i]);
    send('*');
    for (int8_t shift = 12; shift >= 0; shift -= 4)
        send(hex_digit(crc >> shift & 15));
    send('\n');
}

/* One unsigned number of up to six decimal or four hexadecimal digits at *text, ended by a space or the end. */
static uint8_t number_at(const char **text, uint8_t radix, uint32_t most, uint32_t *number)
{
    const char *at = *text;
    uint32_t value = 0;
    uint8_t digits = 0;
    if (*at++ != ' ')
        return 0;
    for (; *at && *at != ' '; at++, digits++) {
        uint8_t digit;
        if (*at >= '0' && *at <= '9')
            digit = *at - '0';
        else if (radix == 16 && *at >= 'A' && *at <= 'F')
            digit = *at - 'A' + 10;
        else
            return 0;
        value = value * radix + digit;
    }
    if (digits == 0 || digits > (radix == 16 ? 4 : 6) || value > most)
        return 0;
    *text = at;
    *number = value;
    return 1;
}

static uint16_t ticks(uint32_t us)
{
    return (us + TICK_US / 2) / TICK_US;
}

static void begin_release(uint16_t mask, uint32_t pulse_us)
{
    uint16_t last = 0;
    for (uint8_t channel = 0; channel < CHANNELS; channel++)
        if (mask >> channel & 1 && delay_ticks[channel] > last)
            last = delay_ticks[channel];
    pulse_ticks = ticks(pulse_us) ? ticks(pulse_us) : 1;
    fire_mask = mask;
    fire_tick = 0;
    fire_last = last + pulse_ticks;
    firing = 1;
    TCNT2 = 0;
    TIFR2 = _BV(OCF2A);
    release_tick(0);
    TCCR2B = _BV(CS21); /* 2 MHz */
}

/* A command takes the text after its name and writes its reply; it returns the error that is its reply instead, or 0. */
typedef const char *command(const char *rest);

static const char argument_error[] PROGMEM = "ERR ARGUMENT";
static const char busy_error[] PROGMEM = "ERR BUSY";
static const char not_armed_error[] PROGMEM = "ERR NOT-ARMED";
static const char unknown_error[] PROGMEM = "ERR UNKNOWN";

static const char *ok(void)
{
    put_text(PSTR("OK"));
    return 0;
}

static void put_field(uint32_t number)
{
    put_text(PSTR(" "));
    put_number(number, 10);
}

static const char *identify(const char *rest)
{
    if (*rest)
        return argument_error;
    put_text(PSTR("OK eigenhead-trigger/1 FW=1.0.0 ID=" STRING(BOX_ID) " CH=" STRING(CHANNELS) " LI=" STRING(LIGHTS)));
    return 0;
}

static const char *tell_clock(const char *rest)
{
    if (*rest)
        return argument_error;
    ok();
    put_field(clock_us());
    return 0;
}

static const char *set_delay(const char *rest)
{
    uint32_t channel, us;
    if (!number_at(&rest, 10, CHANNELS - 1, &channel) || !number_at(&rest, 10, DELAY_MOST_US, &us) || *rest)
        return argument_error;
    if (firing)
        return busy_error;
    delay_ticks[channel] = ticks(us);
    return ok();
}

static const char *arm(const char *rest)
{
    uint32_t window_ms;
    if (!number_at(&rest, 10, WINDOW_MOST_MS, &window_ms) || *rest)
        return argument_error;
    if (firing)
        return busy_error;
    armed = 1;
    armed_at_us = clock_us();
    window_us = window_ms * 1000;
    return ok();
}

static const char *disarm(const char *rest)
{
    if (*rest)
        return argument_error;
    armed = 0;
    return ok();
}

static const char *fire(const char *rest)
{
    uint32_t mask, pulse_us, now_us;
    if (!number_at(&rest, 16, (1UL << CHANNELS) - 1, &mask) || !number_at(&rest, 10, PULSE_MOST_US, &pulse_us) || *rest
        || !pulse_us)
        return argument_error;
    if (!armed)
        return not_armed_error;
    armed = 0;
    shots++;
    now_us = clock_us();
    begin_release(mask, pulse_us);
    ok();
    put_field(now_us);
    put_field(shots);
    return 0;
}

static const char *set_lights(const char *rest)
{
    uint32_t mask;
    if (!number_at(&rest, 16, (1UL << LIGHTS) - 1, &mask) || *rest)
        return argument_error;
    lights = mask;
    PORTC = (PORTC & 0xF0) | lights;
    return ok();
}

static const char *status(const char *rest)
{
    if (*rest)
        return argument_error;
    put_text(PSTR("OK STATE="));
    put_text(firing ? PSTR("FIRING") : armed ? PSTR("ARMED") : PSTR("IDLE"));
    put_text(PSTR(" SHOTS="));
    put_number(shots, 10);
    put_text(PSTR(" LIGHTS="));
    put_number(lights, 16);
    put_text(PSTR(" BAD="));
    put_number(bad_lines, 10);
    return 0;
}

static const struct {
    char name[9];
    command *run;
} commands[] PROGMEM = {
    {"IDENTIFY", identify}, {"CLOCK", tell_clock}, {"DELAY", set_delay}, {"ARM", arm},
    {"DISARM", disarm}, {"FIRE", fire}, {"LIGHTS", set_lights}, {"STATUS", status},
};

/* Acts on one request; writes its reply, or returns the error that is the reply. */
static const char *act(const char *body)
{
    for (uint8_t i = 0; i < sizeof commands / sizeof *commands; i++) {
        uint8_t length = strlen_P(commands[i].name);
        if (!strncmp_P(body, commands[i].name, length) && (!body[length] || body[length] == ' '))
            return ((command *)pgm_read_ptr(&commands[i].run))(body + length);
    }
    return unknown_error;
}

static uint8_t hex_value(char digit, uint8_t *valid)
{
    if (digit >= '0' && digit <= '9')
        return digit - '0';
    if (digit >= 'A' && digit <= 'F')
        return digit - 'A' + 10;
    *valid = 0;
    return 0;
}

/* Sequence number and checksum of the line between '@' and the newline; 0 where it is damaged. */
static uint8_t check_line(uint8_t *sequence, uint16_t *checksum)
{
    uint8_t valid = 1, length = line_length - 5;
    uint16_t crc = 0xFFFF;
    if (line_length < 9 || line[length] != '*' || line[2] != ' ')
        return 0;
    *sequence = hex_value(line[0], &valid) << 4 | hex_value(line[1], &valid);
    *checksum = 0;
    for (uint8_t i = 1; i <= 4; i++)
        *checksum = *checksum << 4 | hex_value(line[length + i], &valid);
    for (uint8_t i = 0; i < length; i++) {
        valid &= line[i] >= ' ' && line[i] <= '~';
        crc = crc_step(crc, line[i]);
    }
    return valid && crc == *checksum;
}

/* Answers a line. The same request once more is a reply that got lost: it is answered again and not acted on. */
static void answer(void)
{
    uint8_t sequence;
    uint16_t checksum;
    if (!check_line(&sequence, &checksum)) {
        bad_lines++;
        return;
    }
    if (!last_valid || sequence != last_sequence || checksum != last_checksum) {
        const char *error;
        line[line_length - 5] = 0;
        reply_length = 0;
        error = act(line + 3);
        if (error)
            put_text(error);
        last_valid = 1;
        last_sequence = sequence;
        last_checksum = checksum;
    }
    send_reply(sequence);
}

static void take(uint8_t byte)
{
    if (byte == '@') {
        bad_lines += in_line;
        in_line = 1;
        line_length = 0;
    } else if (!in_line) {
        return;
    } else if (byte == '\n') {
        in_line = 0;
        answer();
    } else if (line_length == LINE_MOST) {
        in_line = 0;
        bad_lines++;
    } else {
        line[line_length++] = byte;
    }
}

static void set_up(void)
{
    DDRD |= 0xFC;
    DDRB |= 0x3F;
    DDRC |= 0x0F;
    UBRR0 = UBRR_VALUE;
#if USE_2X
    UCSR0A = _BV(U2X0);
#endif
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
    TCCR1B = _BV(CS11); /* 2 MHz */
    TIMSK1 = _BV(TOIE1);
    TCCR2A = _BV(WGM21);
    OCR2A = TICK_US * 2 - 1;
    TIMSK2 = _BV(OCIE2A);
    wdt_enable(WDTO_250MS);
    set_sleep_mode(SLEEP_MODE_IDLE);
    sei();
}

int main(void)
{
    set_up();
    for (;;) {
        wdt_reset();
        if (armed && clock_us() - armed_at_us > window_us)
            armed = 0;
        if (line_broken) {
            line_broken = 0;
            bad_lines += in_line;
            in_line = 0;
        }
        if (ring_tail != ring_head) {
            uint8_t byte = ring[ring_tail];
            ring_tail = (ring_tail + 1) & (RING - 1);
            take(byte);
            continue;
        }
        cli(); /* a byte that comes between the test and the sleep must still wake us */
        if (ring_tail == ring_head && !line_broken) {
            sleep_enable();
            sei();
            sleep_cpu();
            sleep_disable();
        }
        sei();
    }
}
