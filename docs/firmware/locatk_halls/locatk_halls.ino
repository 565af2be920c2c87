// Four analog hall sensors under a robot, for `locatk capture PORT --device locatk`.
//
// Library: locatk (see README.md in the parent folder). Part of locatk, BSD-3-Clause.

#include "locatk_frame.h"

const char NAME[] = "locatk_halls 1.0";
const uint32_t BAUD = 115200;
const uint8_t PINS[] = {A0, A1, A2, A3};  // front, left, rear, right
const uint8_t SENSORS = sizeof PINS;
const uint8_t SAMPLES = 5;                // per frame
const uint32_t PERIOD_US = 4000;          // between two samples
const int MIDDLE = 512;                   // reading without a field
// Microtesla per count, positive if the field points up; negate the counts below if your
// sensors are mounted upside down. DRV5055A2: 50 mV/mT at 5 V, read with 10 bits of 5 V.
const float SCALE = 1000.0f * 5000.0f / 1024.0f / 50.0f;

uint8_t memory[LOCATK_MEMORY(LOCATK_SERIES_PAYLOAD(SAMPLES, SENSORS))];
locatk_writer out;
int16_t counts[SAMPLES][SENSORS];
uint8_t taken;
uint32_t first_us;  // time of the first sample of the frame
uint32_t due_us;
uint32_t greeted_ms;

void sendFrame(size_t length) { Serial.write(out.memory, length); }

void greet() {
  greeted_ms = millis();
  sendFrame(locatk_hello(&out, micros(), 1000000, NAME));
}

void sendSamples() {
  if (!taken) return;
  locatk_series(&out, LOCATK_HALLS, first_us, SENSORS, taken, LOCATK_COUNTS,
                taken > 1 ? PERIOD_US : 0);
  locatk_put_f32(&out, SCALE);
  for (uint8_t sample = 0; sample < taken; sample++)
    for (uint8_t n = 0; n < SENSORS; n++) locatk_put_i16(&out, counts[sample][n]);
  sendFrame(locatk_end(&out));
  taken = 0;
}

void setup() {
  Serial.begin(BAUD);
  locatk_init(&out, memory, sizeof memory, 0);
  greet();
  due_us = micros();
}

void loop() {
  if (millis() - greeted_ms >= 1000) greet();
  uint32_t late_us = micros() - due_us;
  if (late_us >= 0x80000000) return;  // not due yet: the difference is negative
  if (late_us >= PERIOD_US) {         // too late for the even series of this frame
    sendSamples();
    due_us += late_us;
  }
  if (!taken) first_us = due_us;
  for (uint8_t n = 0; n < SENSORS; n++) counts[taken][n] = (int16_t)(analogRead(PINS[n]) - MIDDLE);
  due_us += PERIOD_US;
  if (++taken == SAMPLES) sendSamples();
}
