// Steps and straight lines over time. See reference_line.h.

#include "reference_line.h"

void
model_line_fill(struct model_line *line, const double *pairs)
{
    for (int i = 0; i < line->count; i++) {
        line->at[i] = pairs[2 * i];
        line->at[line->count + i] = pairs[2 * i + 1];
    }
}

int
model_line_passed(const struct model_line *line, double time_s)
{
    int low = 0, high = line->count;
    while (low < high) {
        int middle = (low + high) / 2;
        if (time_s < line->at[middle])
            high = middle;
        else
            low = middle + 1;
    }
    return low;
}

double
model_line_step(const struct model_line *line, double time_s)
{
    int passed = model_line_passed(line, time_s);
    return passed ? line->at[line->count + passed - 1] : line->before;
}

double
model_line_corner(const struct model_line *line, double time_s)
{
    const double *times_s = line->at, *values = line->at + line->count;
    int after = model_line_passed(line, time_s);
    if (!after)
        return values[0];
    if (after == line->count)
        return values[after - 1];
    double start_s = times_s[after - 1], start = values[after - 1];
    double share = (time_s - start_s) / (times_s[after] - start_s);
    return start + share * (values[after] - start);
}
