"""C code as a firmware has it: built by gcc, or for a Cortex-M without any library and run in an emulator.

The programs read records of float32 from their standard input and write the answers. On a Cortex-M there is no system:
the records come by Linux's calls (`svc 0`), which qemu-arm answers.
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
from tools import tool

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow")
M4 = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
M0 = ("-mcpu=cortex-m0plus", "-mthumb", "-mfloat-abi=soft")

INPUT_AND_OUTPUT = """
#include <stddef.h>
#if defined(__arm__)
static long call(long number, long a, long b, long c)
{
    register long r7 __asm__("r7") = number;
    register long r0 __asm__("r0") = a;
    register long r1 __asm__("r1") = b;
    register long r2 __asm__("r2") = c;
    __asm__ volatile("svc #0" : "+r"(r0) : "r"(r7), "r"(r1), "r"(r2) : "memory");
    return r0;
}
static long get(void *to, size_t size) { return call(3, 0, (long)to, (long)size); }
static void put(const void *from, size_t size) { (void)call(4, 1, (long)from, (long)size); }
int main(void);
void _start(void);
void _start(void) { (void)call(1, main(), 0, 0); for (;;) { } }
#else
#include <unistd.h>
static long get(void *to, size_t size) { return (long)read(0, to, size); }
static void put(const void *from, size_t size) { if (write(1, from, size) < 0) { _exit(9); } }
#endif
static float in[COLUMNS];
static int filled(void)
{
    size_t have = 0;
    while (have < sizeof in) {
        const long more = get((char *)in + have, sizeof in - have);
        if (more <= 0) { return 0; }
        have += (size_t)more;
    }
    return 1;
}
"""

AT_REST = """
#include "gyro_bias.h"
int main(void)
{
    float bias[GYRO_BIAS_AXES];
    while (filled()) { gyro_bias(in[0], bias); put(bias, sizeof bias); }
    return 0;
}
"""

RUNNING = """
#include "gyro_bias.h"
int main(void)
{
    gyro_bias_state state;
    float bias[GYRO_BIAS_AXES];
    int begun = 0;
    while (filled()) {
        if (!begun) { gyro_bias_init(&state, ARGUMENTS); begun = 1; }
        gyro_bias_step(&state, in[0], ARGUMENTS, bias);
        put(bias, sizeof bias);
    }
    return 0;
}
"""


def built(folder: Path, program: str, columns: int, flags, *, arguments: str = "", arm: bool = False) -> list[str]:
    """Compile folder/gyro_bias.c under the flags with a program that calls it; return the command that runs it."""
    own = Path(tempfile.mkdtemp(dir=folder))
    (own / "main.c").write_text(INPUT_AND_OUTPUT + program)
    around = [flag for flag in flags if flag.startswith(("-m", "-fsan"))]
    compiler = [tool("arm-none-eabi-gcc"), "-ffreestanding"] if arm else [tool("gcc")]
    defined = [f"-DCOLUMNS={columns}", f"-DARGUMENTS={arguments}", f"-I{folder}", "-O2", "-fomit-frame-pointer"]
    for source, given in ((folder / "gyro_bias.c", flags), (own / "main.c", [*around, *defined])):
        subprocess.run([*compiler, *given, "-c", str(source), "-o", str(own / f"{source.stem}.o")], check=True)
    link = ["-nostdlib", "-nostartfiles"] if arm else []
    objects = [str(own / "gyro_bias.o"), str(own / "main.o"), *(["-lgcc"] if arm else [])]
    subprocess.run([*compiler, *around, *link, *objects, "-o", str(own / "program")], check=True)
    return [tool("qemu-arm"), str(own / "program")] if arm else [str(own / "program")]


def answers(command: list[str], records: np.ndarray, axes: int = 3) -> np.ndarray:
    """Return what the program answers to records (N, columns): (N, axes) float32."""
    done = subprocess.run(command, input=records.astype("<f4").tobytes(), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert not done.stderr, done.stderr.decode()[-2000:]
    return np.frombuffer(done.stdout, dtype="<f4").reshape(-1, axes)


def bits(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype="<f4").view("<u4")
