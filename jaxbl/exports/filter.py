"""A program in C that reads samples as CSV and writes the outputs of the exported code: an example, and what tests run."""

from jaxbl.records import POSITION_CHANNELS

from .block import Program
from .c import c_type, comment, plain_text


def columns(program: Program) -> list[str]:
    """Columns that it reads."""
    sides = [one.name.removesuffix("_position") for one in program.block.first]
    return ["t", "u", *(POSITION_CHANNELS[side] for side in sides)]


def filter_code(program: Program) -> str:
    """The program, which reads columns `t,u,theta_e,theta_s` (`t,u,theta_e` of a rigid drive)."""
    block, name = program.block, program.block.name
    real, single = c_type(block.dtype), c_type(block.dtype) == "float"
    read = columns(program)
    about = [
        f"Reads samples as lines '{','.join(read)}' (s, N m, rad), and writes the outputs of {name} as CSV.",
        "",
        f"    cc -std=c99 -O2 {name}.c {name}_filter.c -lm -o {name}_filter",
        f"    ./{name}_filter < log.csv > found.csv",
        f"    ./{name}_filter log.csv found.csv",
        "",
        "Lines have to come at the sampling period; times are only copied. A first line without numbers is passed over.",
    ]
    formats = ["%.9g" if single else "%.17g", *("%d" if one.dtype == bool else "%.9g" if single else "%.17g"
               for one in block.outputs)]  # fmt: skip
    names = ["t", *(one.name for one in block.outputs)]
    cast = "(double)" if single else ""
    printed = [f"{cast}row[0]", *(
        f"outputs.{one.name} ? 1 : 0" if one.dtype == bool else f"{cast}outputs.{one.name}" for one in block.outputs
    )]  # fmt: skip
    places = {"input": "row[1]"} | {one.name: f"row[{2 + i}]" for i, one in enumerate(block.first)}
    head = "\n".join(comment(about))
    text = f'''{head}

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "{name}.h"

#define COLUMNS {len(read)}
#define LONGEST 1024

/* The numbers of a line; 0 where there are not {len(read)}. */
static int numbers(const char *line, {real} row[COLUMNS])
{{
    const char *at = line;
    int i;
    for (i = 0; i < COLUMNS; i++)
    {{
        char *end = NULL;
        row[i] = {"strtof" if single else "strtod"}(at, &end);
        if (end == at)
        {{
            return 0;
        }}
        at = end;
        while ((*at == ' ') || (*at == '\\r') || (*at == '\\n'))
        {{
            at++;
        }}
        if (*at != ((i < (COLUMNS - 1)) ? ',' : '\\0'))
        {{
            return 0;
        }}
        at++;
    }}
    return 1;
}}

int main(int argc, char *argv[])
{{
    static {name}_state state;
    {name}_outputs outputs;
    char line[LONGEST];
    {real} row[COLUMNS];
    unsigned long count = 0ul;
    int started = 0;
    FILE *in = (argc > 1) ? fopen(argv[1], "r") : stdin;
    FILE *out = (argc > 2) ? fopen(argv[2], "w") : stdout;
    if ((in == NULL) || (out == NULL))
    {{
        fprintf(stderr, "{name}_filter: cannot open %s\\n", (in == NULL) ? argv[1] : argv[2]);
        return 2;
    }}
    fprintf(out, "{",".join(names)}\\n");
    while (fgets(line, LONGEST, in) != NULL)
    {{
        count++;
        if ((strchr(line, '\\n') == NULL) && (feof(in) == 0))
        {{
            fprintf(stderr, "{name}_filter: line %lu is longer than %d letters\\n", count, LONGEST - 2);
            return 2;
        }}
        if (numbers(line, row) == 0)
        {{
            if (count == 1ul)
            {{
                continue;
            }}
            fprintf(stderr, "{name}_filter: line %lu should be {len(read)} numbers: {",".join(read)}\\n", count);
            return 2;
        }}
        if (started == 0)
        {{
            {name}_init({", ".join(["&state", *(places[one.name] for one in block.first)])});
            started = 1;
        }}
        {name}_step({", ".join(["&state", *(places[one.name] for one in block.inputs), "&outputs"])});
        fprintf(out, "{",".join(formats)}\\n",
                {f",{chr(10)}                ".join(printed)});
    }}
    return ((fclose(out) == 0) && (started == 1)) ? 0 : 1;
}}
'''
    return plain_text(text)
