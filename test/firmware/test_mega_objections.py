"""The Mega's emulator is strict: what the datasheet forbids or the model does not have ends the run with a sentence."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from chip_rig import Chip
from simulation import builds

AVR = ["avr-gcc", "-std=gnu11", "-mmcu=atmega2560", "-DF_CPU=16000000UL", "-Os", "-Wall", "-Werror"]
HEAD = "#include <avr/io.h>\n#include <avr/interrupt.h>\n#include <avr/wdt.h>\n"


def run(folder: Path, program: str, before: str = "") -> Chip:
    """A few lines of C on the chip, for 20 ms; `before` stands outside of main()."""
    source, image = folder / "tiny.c", folder / "tiny.elf"
    source.write_text(f"{HEAD}{before}\nint main(void)\n{{\n{program}\n    for (;;)\n        ;\n}}\n")
    subprocess.run([*AVR, str(source), "-o", str(image)], check=True)
    build = builds.BUILDS["atmega2560"]
    builds.make([build.library], "The emulator")
    chip = Chip(build, image)
    chip.run_to(chip.now + 16_000 * 20)
    return chip


OBJECTIONS = {
    "a register the model does not have": ("EICRA = 12;", "written to register 0x069"),
    "a peripheral without power": (
        "PRR0 = 1 << PRUSART0; UBRR0 = 7;",
        "USART0 is used while its power is off",
    ),
    "a byte sent with the transmitter off": ("UDR0 = 1;", "transmitter is off"),
    "a byte sent over the one that waits": (
        "UCSR0B = 1 << TXEN0; UDR0 = 1; UDR0 = 2; UDR0 = 3;",
        "waits there",
    ),
    "an ADC too fast for ten bits": (
        "ADMUX = 0x40; ADCSRA = 1 << ADEN | 1 << ADSC | 4;",
        "runs at 1000000 Hz",
    ),
    "a conversion with the ADC off": ("ADMUX = 0x40; ADCSRA = 1 << ADSC | 7;", "while the ADC is off"),
    "an input changed in a conversion": (
        "ADMUX = 0x40; ADCSRA = 1 << ADEN | 1 << ADSC | 7; ADMUX = 0x41;",
        "during a",
    ),
    "SPI without its pins": ("SPCR = 1 << SPE | 1 << MSTR; SPDR = 1;", "PB0, PB1 and PB2 must be outputs"),
    "I2C without power": (
        "TWBR = 72; PRR0 = 1 << PRTWI; TWCR = 1 << TWINT | 1 << TWEN;",
        "TWI is used while",
    ),
    "a bus faster than any device": ("TWBR = 2; TWCR = 1 << TWINT | 1 << TWEN | 1 << TWSTA;", "at 800000 Hz"),
    "a byte on a bus without a start": (
        "TWBR = 72; TWDR = 1; TWCR = 1 << TWINT | 1 << TWEN;",
        "before a start",
    ),
    "a watchdog changed without the key": ("WDTCSR = 1 << WDE | 5;", "without opening it first"),
    "a clock with another mode": ("TCCR5B = 3;", "undivided"),
    "fast PWM": ("DDRB = 0xff; TCCR2B = 1; TCCR2A = 0x83;", "phase correct"),
    "a jump into nowhere": ("((void (*)(void))0x7000)();", "stopped"),
}


@pytest.mark.parametrize("what", OBJECTIONS)
def test_objects_to(tmp_path: Path, what: str) -> None:
    program, text = OBJECTIONS[what]
    fault = run(tmp_path, f"    {program}").fault()
    assert text in fault and fault.startswith("The emulated ATmega2560 objects")


def test_does_not_object_to_what_is_right(tmp_path: Path) -> None:
    chip = run(
        tmp_path,
        "    wdt_enable(WDTO_2S); UBRR0 = 7; UCSR0A = 2; UCSR0B = 1 << TXEN0; UDR0 = 'h'; UDR0 = 'i';"
        " ADMUX = 0x40; ADCSRA = 1 << ADEN | 1 << ADSC | 7; while (ADCSRA & 1 << ADSC) ; DDRB = 1; PINB = 1;",
    )
    assert chip.fault() == "" and [data for _, data in chip.sent] == [b"h", b"i"]
    assert chip.pin_writes[-1][1:] == (8, 1)
    # ten bits of start, data and stop at 250000 baud: 640 cycles from byte to byte, exactly
    assert chip.sent[1][0] - chip.sent[0][0] == 640


def test_a_program_that_does_not_feed_the_watchdog_is_reset(tmp_path: Path) -> None:
    chip = run(tmp_path, "    wdt_enable(WDTO_15MS);")
    assert chip.lib.sim_mcu_take_reset() == 1


def test_an_interrupt_takes_what_the_datasheet_says(tmp_path: Path) -> None:
    """From the overflow to the first instruction of its handler: five cycles, and the jump in the vector table three;
    the idle loop's rjmp that is under way ends first: at most two."""
    handler = '__attribute__((naked)) ISR(TIMER5_OVF_vect) { __asm__ volatile("sbi 3, 0\\n reti"); }'
    chip = run(tmp_path, "    TCCR5B = 1; TIMSK5 = 1 << TOIE5; DDRB = 1; sei();", handler)
    toggles = [clock for clock, pin, _ in chip.pin_writes if pin == 8][1:]
    delay = (toggles[0] - chip.chip.peek("timer5.zero")) % 65536
    assert 5 + 3 <= delay <= 5 + 3 + 2
    assert len(toggles) == 4  # in 20 ms, one every 4.096
