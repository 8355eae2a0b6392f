#pragma once
#include "splat/project_backward.h"

namespace avatar::splat {
namespace {

// Takes Gaussians with the sums of their moments one by one and writes their gradients a batch at a time. Those whose
// moments are all 0, hidden or behind all others, have none.
class Batches {
public:
    Batches(const View& view, const Gaussians& gaussians, const GaussianGradients& gradients, bool has_pose)
        : view_(view), gaussians_(gaussians), gradients_(gradients), pose_(has_pose ? &pose_sums_ : nullptr) {}

    void add(std::int64_t i, const double own[kMoments]) {
        bool any = false;
        for (int k = 0; k < kMoments; ++k) any |= own[k] != 0.0;
        if (!any) {
            clear(gradients_, i, 3 * std::int64_t{gaussians_.coefficients});
            return;
        }
        for (int k = 0; k < kMoments; ++k) sums_.moments[k][count_] = own[k];
        indices_[count_++] = i;
        if (count_ == kBatch) write();
    }

    // What the Gaussians add to the camera's gradient goes to `grad_pose` [kPoseValues], unless that is null.
    void finish(double* grad_pose) {
        for (int k = 0; k < kMoments; ++k)
            for (int lane = count_; lane < kBatch; ++lane) sums_.moments[k][lane] = 0.0;
        if (count_ > 0) write();
        if (grad_pose == nullptr) return;
        for (int k = 0; k < kPoseValues; ++k) {
            grad_pose[k] = 0.0;
            for (int lane = 0; lane < kBatch; ++lane) grad_pose[k] += pose_sums_.values[k][lane];
        }
    }

private:
    void write() {
        batch_backward(view_, gaussians_, indices_, count_, sums_, gradients_, pose_);
        count_ = 0;
    }

    const View& view_;
    const Gaussians& gaussians_;
    const GaussianGradients& gradients_;
    Sums sums_{};
    PoseSums pose_sums_{};
    PoseSums* const pose_;
    std::int64_t indices_[kBatch];
    int count_ = 0;
};

// Writes the gradients of the Gaussians begin .. end - 1.
void project_backward(const View& view, const Gaussians& gaussians, std::int64_t begin, std::int64_t end,
                      const std::uint32_t* slot_begin, const float* moments, const GaussianGradients& gradients,
                      double* grad_pose) {
    Batches batches(view, gaussians, gradients, grad_pose != nullptr);
    for (std::int64_t i = begin; i < end; ++i) {
        double own[kMoments] = {};
        for (std::int64_t slot = slot_begin[i]; slot < slot_begin[i + 1]; ++slot)
            for (int k = 0; k < kMoments; ++k) own[k] += moments[slot * kMoments + k];
        batches.add(i, own);
    }
    batches.finish(grad_pose);
}

// With features, whose own gradients are the sums of theirs.
void project_backward_features(const View& view, const Gaussians& gaussians, std::int64_t begin, std::int64_t end,
                               const std::uint32_t* slot_begin, const float* moments,
                               const GaussianGradients& gradients, double* grad_pose) {
    const int channels = gaussians.channels;
    const std::int64_t stride = kShapeMoments + channels;
    Batches batches(view, gaussians, gradients, grad_pose != nullptr);
    for (std::int64_t i = begin; i < end; ++i) {
        const float *const first = moments + slot_begin[i] * stride, *const last = moments + slot_begin[i + 1] * stride;
        double own[kMoments] = {};
        for (const float* from = first; from != last; from += stride)
            for (int k = 0; k < kShapeMoments; ++k) own[k] += from[k];
        batches.add(i, own);

        float* const to = gradients.features + i * channels;
        int c = 0;
        for (; c + kDoubles <= channels; c += kDoubles) {
            Doubles sum{};
            for (const float* from = first; from != last; from += stride) sum += load_as_doubles(from + kShapeMoments + c);
            store_as_floats(to + c, sum);
        }
        for (; c < channels; ++c) {
            double sum = 0.0;
            for (const float* from = first; from != last; from += stride) sum += from[kShapeMoments + c];
            to[c] = static_cast<float>(sum);
        }
    }
    batches.finish(grad_pose);
}

}  // namespace
}  // namespace avatar::splat
