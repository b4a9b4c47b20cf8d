/* {{ title }}: see {{ header }}.
 * First the model as CasADi generates it, then the interface. */
#include "{{ header }}"

{{ generated }}

#include <string.h>

/* structures of doubles alone are arrays of doubles */
typedef char {{ name }}_layout[sizeof({{ name }}_state) == {{ upper }}_STATES * sizeof(double) &&
    sizeof({{ name }}_input) == {{ upper }}_INPUTS * sizeof(double) &&
    sizeof({{ name }}_output) == {{ upper }}_OUTPUTS * sizeof(double) ? 1 : -1];

{% for kind, ports in (("state", states), ("input", inputs), ("output", outputs)) %}
const char *const {{ name }}_{{ kind }}_names[{{ upper }}_{{ kind | upper }}S] = {
{% for literal in literals[kind] %}    {{ literal }},
{% endfor %}};
{% endfor %}

typedef int {{ name }}_function(const double **, double **, int *, double *, int);

static void {{ name }}_call({{ name }}_function *function, const {{ name }}_state *state,
    const {{ name }}_input *input, double *result)
{
    double x[{{ upper }}_STATES], u[{{ upper }}_INPUTS];
    const double *given[2];
    double *found[1];
    memcpy(x, state, sizeof x);
    memcpy(u, input, sizeof u);
    given[0] = x;
    given[1] = u;
    found[0] = result;
    function(given, found, 0, 0, 0);
}

void {{ name }}_begin({{ name }}_state *state, const {{ name }}_input *first)
{
    double rest[{{ upper }}_STATES];
    {{ name }}_call({{ name }}_generated_begin, state, first, rest);
    memcpy(state, rest, sizeof rest);
}

void {{ name }}_step(const {{ name }}_state *state, const {{ name }}_input *input,
    {{ name }}_state *next)
{
    double after[{{ upper }}_STATES];
    {{ name }}_call({{ name }}_generated_step, state, input, after);
    memcpy(next, after, sizeof after);
}

void {{ name }}_read(const {{ name }}_state *state, const {{ name }}_input *input,
    {{ name }}_output *output)
{
    double seen[{{ upper }}_OUTPUTS];
    {{ name }}_call({{ name }}_generated_read, state, input, seen);
    memcpy(output, seen, sizeof seen);
}
