// Six nodes, integrated with plain steps. See heater_model.h.

#include "heater_model.h"
#include "physics.h"
#include <math.h>

struct model_nodes
model_at_rest(const struct model_params *p, double temp_c)
{
    double share = p->second_j_k ? p->link_w_k / (p->link_w_k + p->second_loss_w_k) : 0.0;
    struct model_nodes rest = {temp_c, temp_c, p->ambient_c + share * (temp_c - p->ambient_c), temp_c, temp_c, 0.0};
    if (p->element_j_k)
        rest.element_c += greater(0.0, model_hold_w(p, temp_c, 0.0, 0.0)) / p->element_w_k;
    return rest;
}

double
model_melt_w_k(const struct model_params *p, double flow_mm3_s)
{
    double capacity_w_k = p->melt_j_mm3_k * flow_mm3_s;
    if (capacity_w_k <= 1e-9 || !p->melt_ua_w_k)
        return 0.0;
    return capacity_w_k * -expm1(-p->melt_ua_w_k / capacity_w_k);
}

double
model_hold_w(const struct model_params *p, double temp_c, double flow_mm3_s, double fan)
{
    double rise_k = temp_c - p->ambient_c;
    double through = p->second_j_k ? p->link_w_k * p->second_loss_w_k / (p->link_w_k + p->second_loss_w_k) : 0.0;
    double hot_k = temp_c + ZERO_CELSIUS_K, cold_k = p->ambient_c + ZERO_CELSIUS_K;
    double radiated = STEFAN_BOLTZMANN * p->radiation_m2 * (pow(hot_k, 4.0) - pow(cold_k, 4.0));
    double melt = model_melt_w_k(p, flow_mm3_s) * (temp_c - p->melt_in_c);
    return (p->loss_w_k + fan * p->fan_w_k + through) * rise_k + radiated + melt;
}

double
model_capacity_j_k(const struct model_params *p, double temp_c)
{
    return p->heat_j_k * (1.0 + p->heat_slope_per_k * (temp_c - 25.0));
}

double
model_heat_per_output_w(const struct model_params *p, double temp_c)
{
    return p->output_w * (1.0 + p->output_slope_per_k * (temp_c - 25.0));
}

// How much of a lag's deviation is left after `h`; without a lag nothing is.
static double
decay(double h, double lag_s)
{
    return lag_s ? exp(-h / lag_s) : 0.0;
}

void
model_advance(const struct model_params *p, struct model_nodes *nodes, const struct model_drive *drive,
              double flow_mm3_s, double fan, double dt_s)
{
    if (dt_s <= 0.0)
        return;
    double steps = dt_s <= p->step_s ? 1.0 : ceil(dt_s / p->step_s), h = dt_s / steps;
    struct model_nodes n = *nodes;
    double air_w_k = p->loss_w_k + fan * p->fan_w_k, radiation = STEFAN_BOLTZMANN * p->radiation_m2;
    double bore_decay = decay(h, p->bore_s), sensor_decay = decay(h, p->sensor_s);
    for (double step = 0.0; step < steps; step++) {
        if (n.flow != flow_mm3_s)
            n.flow = flow_mm3_s + (n.flow - flow_mm3_s) * decay(h, p->flow_s);
        double heat = drive->gain * drive->output * p->output_w * (1.0 + p->output_slope_per_k * (n.temp_c - 25.0));
        if (p->element_j_k) {
            double passed = p->element_w_k * (n.element_c - n.temp_c);
            n.element_c += h * (heat - passed) / p->element_j_k;
            heat = passed;
        }
        double link = p->link_w_k * (n.temp_c - n.second_c), hot_k = n.temp_c + ZERO_CELSIUS_K;
        double net = heat + drive->disturbance_w - link - air_w_k * (n.temp_c - p->ambient_c);
        net -= radiation * (hot_k * hot_k * hot_k * hot_k - p->air_k4);
        if (n.flow > 1e-9)
            net -= model_melt_w_k(p, n.flow) * (n.bore_c - p->melt_in_c);
        if (p->second_j_k)
            n.second_c += h * (link - p->second_loss_w_k * (n.second_c - p->ambient_c)) / p->second_j_k;
        double before_c = n.temp_c;
        n.temp_c += h * net / model_capacity_j_k(p, n.temp_c);
        double middle_c = 0.5 * (before_c + n.temp_c);
        n.sensor_c = p->sensor_s ? middle_c + (n.sensor_c - middle_c) * sensor_decay : n.temp_c;
        n.bore_c = p->bore_s ? middle_c + (n.bore_c - middle_c) * bore_decay : n.temp_c;
    }
    *nodes = n;
}

struct model_nodes
model_nodes_per(const struct model_nodes *a, const struct model_nodes *b, double share)
{
    return (struct model_nodes){
        .element_c = (a->element_c - b->element_c) / share,
        .temp_c = (a->temp_c - b->temp_c) / share,
        .second_c = (a->second_c - b->second_c) / share,
        .sensor_c = (a->sensor_c - b->sensor_c) / share,
        .bore_c = (a->bore_c - b->bore_c) / share,
        .flow = (a->flow - b->flow) / share,
    };
}

void
model_nodes_add(struct model_nodes *nodes, double times, const struct model_nodes *more)
{
    nodes->element_c += times * more->element_c;
    nodes->temp_c += times * more->temp_c;
    nodes->second_c += times * more->second_c;
    nodes->sensor_c += times * more->sensor_c;
    nodes->bore_c += times * more->bore_c;
    nodes->flow += times * more->flow;
}
