"""Exported C on an emulated Cortex-M4, and before the MISRA checks of cppcheck."""

import numpy as np
import pytest
from native import STRICT, UNCONTRACTED, Native, draw_samples, run_program
from test_c import run_native, study

import jaxbl

_SCRIPT = """
ENTRY(reset)
MEMORY { code (rx) : ORIGIN = 0, LENGTH = 4M  ram (rwx) : ORIGIN = 0x20000000, LENGTH = 4M }
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) *(.ARM.ex*) } > code
  .data : { *(.data*) } > ram
  .bss : { *(.bss*) *(COMMON) } > ram
}
"""
_PROGRAM = """
#include <stdint.h>
#include <string.h>
#include "drive.h"
static const float given[][3] = { %(rows)s };
static void call(int what, const void *with)
{ __asm volatile("mov r0, %%0\\n mov r1, %%1\\n bkpt 0xab" : : "r"(what), "r"(with) : "r0", "r1", "memory"); }
static void put(float value)
{ char line[10]; uint32_t bits; int i; memcpy(&bits, &value, 4);
  for (i = 0; i < 8; i++) { line[i] = "0123456789abcdef"[(bits >> (28 - 4 * i)) & 15u]; }
  line[8] = '\\n'; line[9] = 0; call(4, line); }
static void __attribute__((noinline)) run(void)
{ drive_state s; drive_outputs o; unsigned i;
  drive_init(&s, given[0][1], given[0][2]);
  for (i = 0; i < sizeof given / sizeof given[0]; i++) {
    drive_step(&s, given[i][0], given[i][1], given[i][2], &o);
    put(o.motor_torque_estimate); put(o.load_velocity_estimate); }
  call(0x18, (void *)0x20026); }
/* the unit for floats has to be switched on before a function saves its registers */
void reset(void) { *(volatile uint32_t *)0xE000ED88u |= 0xF00000u; __asm volatile("dsb\\n isb"); run(); for (;;) { } }
__attribute__((section(".vectors"), used)) static void (*const vectors[2])(void) = { (void (*)(void))0x20400000, reset };
"""
_CORE = ("-mcpu=cortex-m4", "-mthumb", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-nostartfiles")
_MACHINE = ("qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting-config", "enable=on,target=native")


@pytest.mark.program("arm-none-eabi-gcc", "qemu-system-arm", "gcc")
@pytest.mark.parametrize("kind", ["super_twisting", "kalman", "differentiator_3"])
def test_a_cortex_m4_computes_the_same_bits(tmp_path, kind):
    jaxbl.export(study(kind), tmp_path, precision="float", name="drive")
    inputs = draw_samples(300, 2).astype(np.float32)
    rows = ", ".join("{" + ", ".join(f"{float(x)!r}f" for x in row) + "}" for row in inputs)
    (tmp_path / "board.c").write_text(_PROGRAM % {"rows": rows})
    (tmp_path / "board.ld").write_text(_SCRIPT)
    build = ("arm-none-eabi-gcc", "-std=gnu99", "-O2", *UNCONTRACTED, *_CORE, "-T", "board.ld")
    run_program(*build, "drive.c", "board.c", "-lm", "-o", "board.elf", cwd=tmp_path)
    result = run_program(*_MACHINE, "-kernel", "board.elf", cwd=tmp_path, stdin=-3, timeout=60)
    words = (result.stdout + result.stderr).split()
    view = np.array([int(word, 16) for word in words], np.uint32).view(np.float32).reshape(-1, 2)
    native = Native(tmp_path)
    names = [output["name"] for output in native.summary["outputs"]]
    expected = run_native(native, inputs)[:, [names.index("motor_torque_estimate"), names.index("load_velocity_estimate")]]
    assert (view.view(np.uint32) == np.ascontiguousarray(expected).view(np.uint32)).all()


@pytest.mark.program("arm-none-eabi-gcc")
def test_a_cortex_m4s_compiler_has_nothing_to_say(tmp_path):
    jaxbl.export(study("differentiator_5"), tmp_path, precision="float", name="drive")
    run_program("arm-none-eabi-gcc", *STRICT, *_CORE[:-1], "-c", "drive.c", "-o", "drive.o", cwd=tmp_path)


CHECK = ("cppcheck", "--addon=misra", "--std=c99", "--quiet")


@pytest.mark.program("cppcheck")
@pytest.mark.parametrize(("kind", "precision"), [("super_twisting", "double"), ("differentiator_1", "float")])
def test_cppchecks_misra_rules_find_nothing(tmp_path, kind, precision):
    data = study(kind)
    if precision == "float":
        # whose code differs from that in double precision by its literals
        del data["identifier"]
    jaxbl.export(data, tmp_path, precision=precision, name="drive")
    output = run_program(*CHECK, "drive.c", "drive.h", cwd=tmp_path)
    assert output.stdout + output.stderr == ""


@pytest.mark.program("cppcheck")
def test_cppchecks_misra_rules_find_a_fault(tmp_path):
    (tmp_path / "wrong.c").write_text("int f(int a) { if (a) return 1; else return 2; }\n")
    assert "misra-c2012" in run_program(*CHECK, "wrong.c", cwd=tmp_path).stderr
