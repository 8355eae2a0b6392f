#include "splat/project.h"

namespace avatar::splat {

View::View(const Camera& camera_, const Settings& settings_, const Region& region_)
    : camera(camera_), settings(settings_), region(region_) {
    const double* R = camera.rotation;
    const double* t = camera.translation;
    for (int k = 0; k < 3; ++k) centre[k] = -(R[k] * t[0] + R[3 + k] * t[1] + R[6 + k] * t[2]);
    const double margin_x = 0.3 * 0.5 * camera.width / camera.fx, margin_y = 0.3 * 0.5 * camera.height / camera.fy;
    slope_x[0] = -camera.cx / camera.fx - margin_x;
    slope_x[1] = (camera.width - camera.cx) / camera.fx + margin_x;
    slope_y[0] = -camera.cy / camera.fy - margin_y;
    slope_y[1] = (camera.height - camera.cy) / camera.fy + margin_y;
}

}  // namespace avatar::splat
