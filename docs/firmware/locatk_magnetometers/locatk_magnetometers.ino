// A bar of MLX90393 magnetometers on SPI, for `locatk capture PORT --device locatk`.
//
// Libraries: "Adafruit MLX90393", and locatk (see README.md in the parent folder). For other
// sensors, replace the three ...Sensor functions below. Part of locatk, BSD-3-Clause.

#include <Adafruit_MLX90393.h>
#include <math.h>

#include "locatk_frame.h"

const char NAME[] = "locatk_magnetometers 1.0";
const uint32_t BAUD = 115200;         // 50 frames of 9 sensors take 56 % of it; USB ignores it
const uint32_t PERIOD_US = 20000;     // at least two conversions of 8.4 ms
const uint8_t CHIP_SELECT[] = {2, 3, 4, 5, 7, 9, 10, 11, 15};  // pins, in the order of the bar
const uint8_t SENSORS = sizeof CHIP_SELECT;

Adafruit_MLX90393 sensors[SENSORS];
bool found[SENSORS];

uint8_t memory[LOCATK_MEMORY(LOCATK_SERIES_PAYLOAD(1, 3 * SENSORS))];
locatk_writer out;
uint32_t due_us;      // time of the next sample
uint32_t started_us;  // start of the running conversions
uint32_t greeted_ms;

bool beginSensor(uint8_t n) {
  return sensors[n].begin_SPI(CHIP_SELECT[n]) && sensors[n].setGain(MLX90393_GAIN_1X) &&
         sensors[n].setOversampling(MLX90393_OSR_2) && sensors[n].setFilter(MLX90393_FILTER_3);
}

void startSensor(uint8_t n) { sensors[n].startSingleMeasurement(); }

// Field in microtesla along the axes of the bar: x forward, y left, z up.
bool readSensor(uint8_t n, float *xyz) { return sensors[n].readMeasurement(xyz, xyz + 1, xyz + 2); }

void sendFrame(size_t length) { Serial.write(out.memory, length); }

void greet() {
  greeted_ms = millis();
  sendFrame(locatk_hello(&out, micros(), 1000000, NAME));
}

void startAll() {
  started_us = micros();
  for (uint8_t n = 0; n < SENSORS; n++)
    if (found[n]) startSensor(n);
}

void setup() {
  Serial.begin(BAUD);
  locatk_init(&out, memory, sizeof memory, 0);
  // Deselect all chips, so that none receives commands for another one.
  for (uint8_t n = 0; n < SENSORS; n++) {
    pinMode(CHIP_SELECT[n], OUTPUT);
    digitalWrite(CHIP_SELECT[n], HIGH);
  }
  greet();
  for (uint8_t n = 0; n < SENSORS; n++) {
    found[n] = beginSensor(n);
    if (!found[n]) {
      char words[] = "no sensor 000";
      words[10] = (char)('0' + n / 100);
      words[11] = (char)('0' + n / 10 % 10);
      words[12] = (char)('0' + n % 10);
      sendFrame(locatk_text(&out, micros(), LOCATK_ERROR, words));
    }
  }
  startAll();
  due_us = started_us + PERIOD_US;
}

void loop() {
  if (millis() - greeted_ms >= 1000) greet();
  uint32_t late_us = micros() - due_us;
  if (late_us >= 0x80000000) return;  // not due yet: the difference is negative
  due_us += late_us < PERIOD_US / 2 ? PERIOD_US : late_us + PERIOD_US;

  locatk_series(&out, LOCATK_MAGNETOMETERS, started_us, SENSORS, 1, 0, 0);
  for (uint8_t n = 0; n < SENSORS; n++) {
    float xyz[3];
    bool valid = found[n] && readSensor(n, xyz);
    for (uint8_t axis = 0; axis < 3; axis++) locatk_put_f32(&out, valid ? xyz[axis] : NAN);
  }
  startAll();  // convert while this frame is sent
  sendFrame(locatk_end(&out));
}
