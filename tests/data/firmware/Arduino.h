/* As much of the Arduino core as the sketches under docs/firmware use, for a test on the host.
 * Time passes only while somebody looks at it or waits. */
#ifndef ARDUINO_H
#define ARDUINO_H

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>

#define OUTPUT 1
#define HIGH 1

enum { A0 = 14, A1, A2, A3 };

/* micros() starts again early in a run, as it does on a board after 71 minutes. */
inline uint64_t &host_time_us()
{
    static uint64_t now = 0xFFF00000u;
    return now;
}

inline unsigned long micros()
{
    return (uint32_t)(host_time_us() += 7);
}

inline unsigned long millis()
{
    return (uint32_t)((host_time_us() += 7) / 1000);
}

inline void delay(unsigned long ms)
{
    host_time_us() += 1000 * ms;
}

inline void pinMode(uint8_t, uint8_t) {}
inline void digitalWrite(uint8_t, uint8_t) {}

inline int analogRead(uint8_t pin)
{
    host_time_us() += 112;
    return 500 + pin;
}

struct HostSerial {
    void begin(unsigned long) {}
    size_t write(const uint8_t *bytes, size_t count)
    {
        return fwrite(bytes, 1, count, stdout);
    }
};
static HostSerial Serial;

#endif
