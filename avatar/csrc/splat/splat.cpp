#include "splat/splat.h"

#include <algorithm>
#include <atomic>
#include <numeric>
#include <stdexcept>
#include <string>

#include "thread_pool.h"

namespace avatar::splat {
namespace {

// 12 bytes and a set of blocks, of 8 to 32 bytes, a pair in the forward pass and 36 more in the backward pass: 6 GB at most.
// Features take 24 bytes and 4 for each channel there.
constexpr std::int64_t kMaxPairs = std::int64_t{1} << 26;
constexpr std::int64_t kRows = 64;    // rows of the image handed to a thread at a time

bool all_finite(const Kernels& kernels, const Gaussians& g, std::int64_t begin, std::int64_t end) {
    const std::int64_t count = end - begin, sh = 3 * static_cast<std::int64_t>(g.coefficients);
    return kernels.all_finite(g.means + 3 * begin, 3 * count) && kernels.all_finite(g.quats + 4 * begin, 4 * count) &&
           kernels.all_finite(g.scales + 3 * begin, 3 * count) && kernels.all_finite(g.opacities + begin, count) &&
           kernels.all_finite(g.sh + sh * begin, sh * count) &&
           kernels.all_finite(g.features + g.channels * begin, g.channels * count);
}

Raster raster_of(const Drawing& d) {
    const Settings& settings = d.view.settings;
    Raster raster{d.splats.get(),
                  d.lists.pairs.get(),
                  d.lists.tile_begin.data(),
                  TileGrid(d.view.region),
                  d.view.camera.width,
                  settings.alpha_min,
                  settings.alpha_max,
                  settings.t_min,
                  {}};
    if (d.background.size() == 3) std::copy(d.background.begin(), d.background.end(), raster.background);
    return raster;
}

// Calls visit(tile, workspace) for all tiles, those with most pairs first. The workspace is null for colours.
template <typename Visit>
void for_each_tile(const Drawing& d, int channels, const Visit& visit) {
    const std::vector<std::uint32_t>& order = d.lists.tile_order;
    parallel_for(d.threads, static_cast<std::int64_t>(order.size()), 1, [&](std::int64_t begin, std::int64_t end) {
        const std::unique_ptr<float[]> workspace(channels > 0 ? new float[d.kernels->feature_workspace(channels)]
                                                              : nullptr);
        for (std::int64_t k = begin; k < end; ++k) visit(order[k], workspace.get());
    });
}

bool is_whole_image(const View& view) {
    const Region& r = view.region;
    return r.left == 0 && r.top == 0 && r.right == view.camera.width && r.bottom == view.camera.height;
}

// Calls visit(first pixel, end pixel) for the parts of the image's rows begin to end - 1 that are outside the region.
template <typename Visit>
void for_each_outside(const View& view, std::int64_t begin, std::int64_t end, const Visit& visit) {
    const std::int64_t width = view.camera.width;
    const Region& region = view.region;
    for (std::int64_t row = begin; row < end; ++row) {
        const bool crosses = row >= region.top && row < region.bottom;
        visit(row * width, row * width + (crosses ? region.left : width));
        if (crosses) visit(row * width + region.right, (row + 1) * width);
    }
}

void draw_outside(const Drawing& drawing, float* image, float* alpha) {
    const View& view = drawing.view;
    const std::vector<float>& background = drawing.background;
    const auto channels = static_cast<std::int64_t>(background.size());
    parallel_for(drawing.threads, view.camera.height, kRows, [&](std::int64_t first_row, std::int64_t end_row) {
        for_each_outside(view, first_row, end_row, [&](std::int64_t begin, std::int64_t end) {
            for (std::int64_t pixel = begin; pixel < end; ++pixel)
                std::copy(background.begin(), background.end(), image + pixel * channels);
            std::fill(alpha + begin, alpha + end, 0.0f);
        });
    });
}

// Adds the cotangents of the pixels outside the region, which show the background.
void add_outside(const Drawing& drawing, const float* grad_image, std::vector<double>& grad_background) {
    const View& view = drawing.view;
    const std::size_t channels = grad_background.size();
    std::vector<double> rows(channels * view.camera.height, 0.0);  // summed in a fixed order below
    parallel_for(drawing.threads, view.camera.height, kRows, [&](std::int64_t first_row, std::int64_t end_row) {
        for (std::int64_t row = first_row; row < end_row; ++row)
            for_each_outside(view, row, row + 1, [&](std::int64_t begin, std::int64_t end) {
                for (std::int64_t pixel = begin; pixel < end; ++pixel)
                    for (std::size_t c = 0; c < channels; ++c)
                        rows[channels * row + c] += grad_image[channels * pixel + c];
            });
    });
    for (std::size_t i = 0; i < rows.size(); ++i) grad_background[i % channels] += rows[i];
}

std::vector<std::uint32_t> tiles_in(const TileSpans* spans_of, std::int64_t count, std::int64_t tile_count) {
    std::vector<std::uint32_t> tiles(tile_count);
    std::uint32_t* next = tiles.data();
    for (std::int64_t i = 0; i < count; ++i)
        for (std::uint32_t k = 0; k < spans_of[i].count; ++k)
            for (std::uint32_t tile = spans_of[i].spans[k].first; tile <= spans_of[i].spans[k].last; ++tile)
                *next++ = tile;
    return tiles;
}

// Projects all Gaussians and makes the tile lists of the visible ones. False when an input is not finite.
bool project_all(const Gaussians& gaussians, Drawing& drawing) {
    const std::int64_t count = gaussians.count, ranges = (count + kRange - 1) / kRange;
    const Kernels& kernels = *drawing.kernels;
    const TileGrid grid(drawing.view.region);
    TileLists& lists = drawing.lists;
    drawing.splats.reset(new Splat[count]);  // not initialised, as the next: written where they are read
    const std::unique_ptr<double[]> depths(new double[count]);
    std::vector<Visibility> visibility(count);
    lists.slot_begin.resize(count + 1);
    std::vector<std::vector<std::uint32_t>> tiles_of(ranges);
    std::atomic<std::int64_t> kept{0};  // pairs whose tiles are
    std::atomic<bool> finite{
        kernels.all_finite(drawing.background.data(), static_cast<std::int64_t>(drawing.background.size()))};
    parallel_for(drawing.threads, count, kRange, [&](std::int64_t begin, std::int64_t end) {
        if (!all_finite(kernels, gaussians, begin, end)) {
            finite = false;
            return;
        }
        SpanStore store;
        TileSpans spans[kRange];
        std::uint32_t* const pairs_of = lists.slot_begin.data() + 1;
        kernels.project(drawing.view, gaussians, begin, end,
                        {grid, drawing.splats.get(), depths.get(), visibility.data(), spans, pairs_of, SpanStore::take,
                         &store});
        const std::int64_t pairs = std::accumulate(pairs_of + begin, pairs_of + end, std::int64_t{0});
        if (kept.fetch_add(pairs) + pairs > kMaxPairs) return;  // refused below: only their number still matters
        tiles_of[begin / kRange] = tiles_in(spans, end - begin, pairs);
    });
    if (!finite) return false;

    std::int64_t pairs = 0;
    for (std::int64_t i = 0; i < count; ++i) {
        if (visibility[i] == Visibility::kColourOverflow)
            throw std::invalid_argument("sh gives splat " + std::to_string(i) +
                                        " a colour beyond the range of float32");
        pairs += lists.slot_begin[i + 1];
        lists.slot_begin[i + 1] = static_cast<std::uint32_t>(pairs);
    }
    if (pairs > kMaxPairs)
        throw std::length_error("drawing needs " + std::to_string(pairs) + " pairs of a tile of " +
                                std::to_string(kTileWidth) + "x" + std::to_string(kTileHeight) +
                                " pixels and a splat, the limit is " + std::to_string(kMaxPairs) +
                                "; are the scales too large for this camera?");
    const std::vector<std::uint32_t> order = depth_order(depths.get(), visibility.data(), count);
    fill_tile_lists(order, tiles_of, grid, drawing.threads, lists);
    return true;
}

}  // namespace

std::unique_ptr<Drawing> forward(const Gaussians& gaussians, const Camera& camera, const Settings& settings,
                                 const Region& region, const float* background, const Kernels& kernels, int threads,
                                 float* image, float* alpha) {
    const int channels = gaussians.channels;
    std::unique_ptr<Drawing> drawing(new Drawing{View(camera, settings, region),
                                                 {background, background + (channels > 0 ? channels : 3)},
                                                 &kernels,
                                                 threads,
                                                 {},
                                                 {},
                                                 {},
                                                 {}});
    if (!project_all(gaussians, *drawing)) return nullptr;

    const std::int64_t tiles = TileGrid(region).count();
    // Not initialised: the kernels write all that they read.
    drawing->ends.reset(new float[tiles * 2 * kTilePixels]);
    drawing->blocks.reset(new Word[drawing->lists.pair_count * kernels.words]);
    const Raster raster = raster_of(*drawing);
    const FeatureChannels features{gaussians.features, drawing->background.data(), channels};
    const ForwardTarget target{image, alpha, drawing->ends.get(), drawing->blocks.get()};
    for_each_tile(*drawing, channels, [&](std::int64_t tile, float* workspace) {
        if (channels > 0)
            kernels.forward_features(raster, features, tile, target, workspace);
        else
            kernels.forward_tile(raster, tile, target);
    });
    if (!is_whole_image(drawing->view)) draw_outside(*drawing, image, alpha);
    return drawing;
}

void backward(const Drawing& drawing, const Gaussians& gaussians, const float* grad_image, const float* grad_alpha,
              const GaussianGradients& gradients, float* grad_background, double* grad_pose) {
    const TileLists& lists = drawing.lists;
    const std::int64_t tiles = TileGrid(drawing.view.region).count();
    const int features = gaussians.channels;
    const std::size_t channels = drawing.background.size();
    // Every slot is written.
    const std::unique_ptr<float[]> moments(
        new float[lists.pair_count * (features > 0 ? kShapeMoments + features : kMoments)]);
    std::vector<double> tile_backgrounds(channels * tiles);
    const Raster raster = raster_of(drawing);
    const FeatureChannels of_features{gaussians.features, drawing.background.data(), features};
    const BackwardSource source{drawing.ends.get(), drawing.blocks.get(), grad_image,
                                grad_alpha};
    const BackwardTarget target{moments.get(), tile_backgrounds.data()};
    for_each_tile(drawing, features, [&](std::int64_t tile, float* workspace) {
        if (features > 0)
            drawing.kernels->backward_features(raster, of_features, tile, source, target, workspace);
        else
            drawing.kernels->backward_tile(raster, tile, source, target);
    });
    std::vector<double> total(channels, 0.0);
    for (std::size_t i = 0; i < tile_backgrounds.size(); ++i) total[i % channels] += tile_backgrounds[i];
    if (grad_image != nullptr && !is_whole_image(drawing.view)) add_outside(drawing, grad_image, total);
    for (std::size_t c = 0; c < channels; ++c) grad_background[c] = static_cast<float>(total[c]);

    const bool has_pose = grad_pose != nullptr;
    const std::int64_t ranges = (gaussians.count + kRange - 1) / kRange;
    std::vector<double> range_poses(has_pose ? kPoseValues * ranges : 0);  // summed in a fixed order below
    parallel_for(drawing.threads, gaussians.count, kRange, [&](std::int64_t begin, std::int64_t end) {
        double* const pose = has_pose ? &range_poses[kPoseValues * (begin / kRange)] : nullptr;
        const auto project = features > 0 ? drawing.kernels->project_backward_features
                                          : drawing.kernels->project_backward;
        project(drawing.view, gaussians, begin, end, lists.slot_begin.data(), moments.get(), gradients, pose);
    });
    if (!has_pose) return;
    std::fill(grad_pose, grad_pose + kPoseValues, 0.0);
    for (std::size_t i = 0; i < range_poses.size(); ++i) grad_pose[i % kPoseValues] += range_poses[i];
}

}  // namespace avatar::splat
