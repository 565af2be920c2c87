/* What the sketch uses of the library "Adafruit MLX90393", with the library's own signatures.
 * Sensor `cs` measures cs + 0.25, -cs and 100 cs; that on pin 5 is not there. */
#ifndef ADAFRUIT_MLX90393_H
#define ADAFRUIT_MLX90393_H

#include "Arduino.h"

typedef enum mlx90393_gain { MLX90393_GAIN_1X = 7 } mlx90393_gain_t;
typedef enum mlx90393_filter { MLX90393_FILTER_3 = 3 } mlx90393_filter_t;
typedef enum mlx90393_oversampling { MLX90393_OSR_2 = 2 } mlx90393_oversampling_t;

struct SPIClass {};
static SPIClass SPI;

class Adafruit_MLX90393 {
public:
    bool begin_SPI(uint8_t cs_pin, SPIClass * = &SPI)
    {
        cs = cs_pin;
        delay(30);
        return cs != 5;
    }
    bool setGain(enum mlx90393_gain) { return true; }
    bool setFilter(enum mlx90393_filter) { return true; }
    bool setOversampling(enum mlx90393_oversampling) { return true; }
    bool startSingleMeasurement(void)
    {
        host_time_us() += 20;
        started = host_time_us();
        return true;
    }
    bool readMeasurement(float *x, float *y, float *z)
    {
        host_time_us() += 60;
        if (host_time_us() - started < 8370) return false;
        *x = cs + 0.25f;
        *y = -cs;
        *z = 100.0f * cs;
        return true;
    }

private:
    uint8_t cs = 0;
    uint64_t started = 0;
};

#endif
