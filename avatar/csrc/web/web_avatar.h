#pragma once
#include <cstdint>
#include <vector>

#include "splat/splat.h"

// A trained avatar that only draws, on one thread: skinning, the latent network, folded HyperGaussians, offsets and
// splatting in one call. The formulas are those of avatar/head/model.py, gaussians/*.py and render.py; the splatter is the
// program's own.
namespace avatar::web {

constexpr int kJoints = 5, kNeckJoint = 1, kPoseValues = 9 * (kJoints - 1), kOffsets = 10;
constexpr int kJaw = 6, kEyes = 12, kEyelids = 2, kNeck = 6, kHeadRotation = 3;

struct Sizes {
    std::int32_t vertices, expressions, gaussians;
    std::int32_t nodes;         // places at which the network is evaluated; `gaussians` of them where there is no grid
    std::int32_t latent;        // values that the network gives; 10 where there are no HyperGaussians
    std::int32_t width, layers; // of the network
    std::int32_t coefficients;  // of the colour
    std::int32_t has_grid, has_heads, has_skull_binding, has_head_rotation;
};

// What moves the head in a frame, as HeadParams, in one array: expression, jaw, eyes, eyelids, neck.
inline int parameter_count(const Sizes& s) { return s.expressions + kJaw + kEyes + kEyelids + kNeck; }
// Of these, the network's inputs; after them, with has_head_rotation, the head's rotation before the camera.
inline int moving_count(const Sizes& s) { return s.expressions + kJaw + kEyes + kEyelids; }
inline int condition_count(const Sizes& s) { return moving_count(s) + (s.has_head_rotation ? kHeadRotation : 0); }

// Every array that does not change, in the order in which a caller fills them.
enum Array {
    kShape,              // [V * 3] the identity at rest
    kExpressionDirs,     // [E * V * 3]
    kPoseDirs,           // [36 * V * 3]
    kWeights,            // [V * 5]
    kEyelidDirs,         // [2 * V * 3]
    kJointsAtRest,       // [5 * 3]
    kExpressionJoints,   // [E * 5 * 3]
    kBarycentric,        // [G * 3]
    kOfCode,             // [M * width] the first layer's product with the positional code
    kForCondition,       // [C * width] its weights for the condition, and
    kInputBias,          // [width]
    kHiddenWeights,      // [(layers - 1) * width * width], input-major
    kHiddenBiases,       // [(layers - 1) * width]
    kOutputWeights,      // [width * latent], input-major
    kOutputBias,         // [latent]
    kGridWeights,        // [G * 4]
    kHeadMatrix,         // [G * latent * 10]
    kHeadBias,           // [G * 10]
    kQuats,              // [G * 4]
    kLogScales,          // [G * 3]
    kOpacityLogits,      // [G]
    kSh,                 // [G * K * 3]
    kSkullShare,         // [G] the share of each Gaussian that keeps with the skull
    kArrays
};

struct Rotation {
    float m[9];
};

// How many values each array has. The sizes may be any that fit into 20 bits, without memory being taken.
void array_lengths(const Sizes& sizes, std::int64_t lengths[kArrays]);

// A Gaussian as a viewer on another device draws it: mean 3, opacity, colour 3 as seen from the camera, and the upper
// triangle of the covariance (xx, xy, xz, yy, yz, zz).
constexpr int kPacked = 13;

class WebAvatar {
public:
    explicit WebAvatar(const Sizes& sizes);

    // Where a caller writes the values of an array; null for one that does not exist.
    float* array(int which);
    std::int32_t* corners() { return corners_.data(); }    // [G * 3] vertices of each Gaussian's triangle
    std::int32_t* cells() { return cells_.data(); }        // [G * 4] nodes around each Gaussian
    float* parameters() { return parameters_.data(); }     // of the next frame
    std::int32_t parents[kJoints] = {-1, 0, 1, 1, 1};
    float head_rotation[kHeadRotation] = {}; // of the next frame: avatar/gaussians/head_rotation.py
    double blur = 0.3;          // pixels^2 added to a splat's variances

    // False when an index lies outside of what it points into.
    bool is_sound() const;

    // Poses the head by `parameters()` and makes the Gaussians.
    void pose();

    // Draws what was posed into 8-bit RGBA [height * width * 4]. False when a value is not
    // finite; throws what splat::forward throws, which ends the module where exceptions are not compiled in.
    bool draw(const splat::Camera& camera, const float background[3], std::uint8_t* rgba);

    // What was posed, for a viewer on another device: [G * kPacked], the farthest from the camera first.
    const float* pack(const splat::Camera& camera);

    const Sizes& sizes() const { return sizes_; }

private:
    void skin();
    void bind_to_skull(const Rotation& turn);
    void evaluate_network();
    void offset();

    Sizes sizes_;
    std::vector<float> arrays_[kArrays];
    std::vector<std::int32_t> corners_, cells_;
    std::vector<float> parameters_, shape_, posed_, points_;
    std::vector<float> layer_, next_layer_, block_, latents_, own_latents_, raw_;
    std::vector<float> means_, quats_, scales_, opacities_;
    std::vector<float> image_, alpha_, packed_;
    std::vector<std::uint32_t> order_;
};

}  // namespace avatar::web
