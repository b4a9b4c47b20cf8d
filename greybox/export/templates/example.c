/* A free run of {{ title }} on the inputs of a log.
 *
 *   cc -O2 -o {{ name }} {{ example }} {{ source }} -lm
 *   ./{{ name }} {{ start }} < trial.csv > run.csv
 *
 * The numbers are the start: {{ start_names }}. The log is CSV with a header and one row every
 * {{ sample_time }} s; columns are found by name: {{ input_names }}.
 * Names may stand in quotes, as greybox import writes them; numbers may not.
 */
#include "{{ header }}"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST_COLUMNS 1024
#define LONGEST_ROW 65536

static char row[LONGEST_ROW];
/* whether a log must have the column, and the value where it has none */
static const int needed[] = { {{ needed | join(', ') }} };
static const double otherwise[] = { {{ otherwise | join(', ') }} };

/* Cut a row at its commas and return how many cells it has. */
static int cells(char *text, char *cell[])
{
    int n = 0;
    text[strcspn(text, "\r\n")] = 0;
    while (n < MOST_COLUMNS) {
        char *comma = strchr(text, ','), *last;
        if (comma)
            *comma = 0;
        last = text + strlen(text) - 1;
        if (last > text && *text == '"' && *last == '"') {
            text++;
            *last = 0;
        }
        cell[n++] = text;
        if (!comma)
            break;
        text = comma + 1;
    }
    return n;
}

int main(int count, char **words)
{
    static char *cell[MOST_COLUMNS];
    int place[{{ upper }}_INPUTS], columns, i, k = 0;
    {{ name }}_state state;
    {{ name }}_input input;
    {{ name }}_output output;
    double *x = (double *)&state, *u = (double *)&input, *y = (double *)&output;

    if (count != 1 + {{ upper }}_MOTION) {
        fprintf(stderr, "usage: %s{% for word in start_names.split(', ') %} {{ word | upper }}{% endfor %} < LOG > RUN\n", words[0]);
        return 2;
    }
    memset(&state, 0, sizeof state);
    for (i = 0; i < {{ upper }}_MOTION; i++)
        x[i] = strtod(words[1 + i], 0);

    if (!fgets(row, sizeof row, stdin)) {
        fprintf(stderr, "the log is empty\n");
        return 1;
    }
    columns = cells(row, cell);
    for (i = 0; i < {{ upper }}_INPUTS; i++) {
        for (place[i] = 0; place[i] < columns; place[i]++)
            if (!strcmp(cell[place[i]], {{ name }}_input_names[i]))
                break;
        if (place[i] < columns)
            continue;
        if (needed[i]) {
            fprintf(stderr, "the log has no column '%s'\n", {{ name }}_input_names[i]);
            return 1;
        }
        place[i] = -1;
        fprintf(stderr, "the log has no column '%s', %g is taken\n", {{ name }}_input_names[i],
            otherwise[i]);
    }
    printf("t");
    for (i = 0; i < {{ upper }}_OUTPUTS; i++)
        printf(",%s", {{ name }}_output_names[i]);
    printf("\n");
    while (fgets(row, sizeof row, stdin)) {
        columns = cells(row, cell);
        if (columns == 1 && !*cell[0])
            continue;
        for (i = 0; i < {{ upper }}_INPUTS; i++) {
            char *end = 0;
            if (place[i] >= columns) {
                fprintf(stderr, "row %d has %d cells, %d are needed\n", k + 2, columns, place[i] + 1);
                return 1;
            }
            u[i] = place[i] < 0 ? otherwise[i] : strtod(cell[place[i]], &end);
            if (end == cell[place[i] < 0 ? 0 : place[i]]) {
                fprintf(stderr, "row %d: '%s' is no number\n", k + 2, end);
                return 1;
            }
        }
        if (k == 0)
            {{ name }}_begin(&state, &input);
        {{ name }}_read(&state, &input, &output);
        printf("%.15g", k++ * {{ upper }}_SAMPLE_TIME);
        for (i = 0; i < {{ upper }}_OUTPUTS; i++)
            printf(",%.17g", y[i]);
        printf("\n");
        {{ name }}_step(&state, &input, &state);
    }
    return 0;
}
