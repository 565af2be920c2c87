/* Runs a sketch (-DSKETCH) on the host for so many seconds; what it sends goes to stdout. */
#include "Arduino.h"

#include SKETCH

#include <stdlib.h>

int main(int, char **arguments)
{
    setup();
    uint64_t end = host_time_us() + 1000000ull * strtoul(arguments[1], NULL, 10);
    while (host_time_us() < end) loop();
    return 0;
}
