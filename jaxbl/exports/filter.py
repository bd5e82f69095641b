"""A program in C that reads samples as CSV and writes the outputs of the exported code: an example, and what tests run."""

from jaxbl.records import POSITION_CHANNELS

from .block import Program
from .c import C_MARKS, c_type
from .writer import write_comment


def input_columns(program: Program) -> list[str]:
    """Return the columns that the program reads."""
    channels = {"input": "u"} | {f"{side}_position": channel for side, channel in POSITION_CHANNELS.items()}
    return ["t", *(channels.get(port.name, port.name) for port in program.block.inputs)]


_PRINTED = {"double": ("%.17g", ""), "float": ("%.9g", "(double)")}
_READ = {"double": "", "float": "(float)"}
"""How numbers of a type are printed and read as double."""


def write_filter_code(program: Program) -> str:
    """Write the program, which reads columns `t,u,theta_e,theta_s` (`t,u,theta_e` of a rigid drive), and with a controller
    those of its target."""
    block, name = program.block, program.block.name
    csv_columns = input_columns(program)
    column_list = ",".join(csv_columns)
    remarks = [
        f"Reads samples as lines '{column_list}' (s, N m, rad), and writes the outputs of {name} as CSV.",
        "",
        f"    cc -std=c99 -O2 {name}.c {name}_filter.c -lm -o {name}_filter",
        f"    ./{name}_filter < log.csv > found.csv",
        f"    ./{name}_filter log.csv found.csv",
        "",
        "Lines have to come at the sampling period; times are only copied. A first line without numbers is passed over.",
    ]
    names, formats, printed = ["t"], ["%.17g"], ["row[0]"]
    for output in block.outputs:
        number_format, cast = _PRINTED.get(c_type(output.dtype), ("%d", "(int)"))
        names.append(output.name)
        formats.append(number_format)
        printed.append(f"{cast}outputs.{output.name}")
    places = {port.name: f"{_READ[c_type(port.dtype)]}row[{i}]" for i, port in enumerate(block.inputs, 1)}
    return f'''{write_comment(C_MARKS, *remarks)}

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "{name}.h"

#define COLUMNS {len(csv_columns)}
#define LONGEST 1024

/* The numbers of a line; 0 where there are not {len(csv_columns)}. */
static int numbers(const char *line, double row[COLUMNS])
{{
    const char *at = line;
    int i;
    for (i = 0; i < COLUMNS; i++)
    {{
        char *end = NULL;
        row[i] = strtod(at, &end);
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
    double row[COLUMNS];
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
            fprintf(stderr, "{name}_filter: line %lu should be {len(csv_columns)} numbers: {column_list}\\n", count);
            return 2;
        }}
        if (started == 0)
        {{
            {name}_init({", ".join(["&state", *(places[quantity.name] for quantity in block.start_inputs)])});
            started = 1;
        }}
        {name}_step({", ".join(["&state", *(places[quantity.name] for quantity in block.inputs), "&outputs"])});
        fprintf(out, "{",".join(formats)}\\n",
                {f",{chr(10)}                ".join(printed)});
    }}
    return ((fclose(out) == 0) && (started == 1)) ? 0 : 1;
}}
'''
