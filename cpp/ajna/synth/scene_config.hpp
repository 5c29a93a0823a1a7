// SPDX-License-Identifier: MIT
#pragma once

#include <cstdint>
#include <string>

namespace ajna::synth {

/// What the scenes look like; defaults are the general-purpose mix. All probabilities are per scene or per layer.
struct SceneConfig {
  // Layers
  std::int64_t layers = 6;               ///< foreground layers at most, each present with layer_probability
  double layer_probability = 0.7;        ///< per layer
  double min_size = 0.06;                ///< smallest layer radius, as a fraction of the shorter image side
  double max_size = 0.45;                ///< largest layer radius, same unit; radii are log-uniform
  double blob_weight = 1.0;              ///< relative frequency of ellipses and smooth blobs
  double polygon_weight = 1.0;           ///< of convex polygons and boxes
  double bar_weight = 1.0;               ///< of thin bars and branches
  double plate_weight = 0.25;            ///< of plates with holes
  double trunk_weight = 0.0;             ///< of trees: an upright trunk with twigs, whose foot is the layer's centre
  double plate_frame_probability = 0.5;  ///< of a plate that ends at a box around its hole
  double hole_union_probability = 0.0;   ///< of a hole that is the union of a blob and a polygon
  double placement_spread = 0.55;  ///< layer centres lie within this of the image centre, as a fraction of its sides

  // Motion, pixels per frame interval at the generated size
  std::string flow_distribution = "exponential";  ///< exponential, uniform or log_uniform
  double flow_mean_px = 4.0;                      ///< mean of exponential; the others run from 0 (0.1) to flow_max_px
  double flow_max_px = 40.0;                      ///< cap of each sampled displacement
  double background_ratio = 0.6;                  ///< background displacement relative to that of the layers
  double rotation_zoom = 0.35;  ///< rotation and zoom displacement at the layer's rim, relative to its displacement
  double perspective_probability = 0.3;  ///< of perspective change, per batch
  double nonrigid_probability = 0.3;     ///< of smooth non-rigid motion, per batch (then half of the layers)
  double attached_probability = 0.15;    ///< of a layer that moves exactly with the background
  double parallax_probability =
      0.25;                          ///< of scenes whose layers move along the background's motion, nearer ones faster
  double static_probability = 0.05;  ///< of scenes whose background does not move at all
  double aligned_probability = 0.0;  ///< of scenes whose largest plane holds still, as in the skills' aligned pairs

  // A camera that moves through a scene in depth, instead of layers that move each on their own ("off"). Depths are
  // relative to the background's. The drawn displacement is that of something at the middle depth,
  // sqrt(depth_near * depth_far): nearer layers move by more, whatever flow_max_px says.
  std::string camera = "off";    ///< off, forward, sideways, fixate (sideways, turning back to the centre) or any
  std::string surface = "wall";  ///< wall: planes across the view; floor: a ground plane, too; table: planes on a table
  double depth_near = 0.1;       ///< nearest layer; depths are log-uniform
  double depth_far = 0.9;        ///< farthest layer
  double focal_min = 0.7;        ///< shortest focal length, in image widths
  double focal_max = 1.2;        ///< longest
  double camera_rotation = 0.15;         ///< standard deviation of the rotation's flow, relative to the displacement
  double camera_height = 0.06;           ///< above the floor, drawn between half and twice this
  double table_tilt_deg = 50.0;          ///< largest angle between the table's normal and the line of sight
  double plane_tilt = 0.1;               ///< standard deviation of the slope of planes across the view
  double independent_probability = 0.0;  ///< of a layer that also moves on its own

  // Appearance
  double blur_probability = 0.3;     ///< of motion blur, per scene
  double shutter = 0.5;              ///< longest open time as a fraction of the frame interval
  double defocus_probability = 0.4;  ///< per scene
  double defocus_max_px = 1.2;       ///< largest Gaussian sigma
  double noise_max = 6.0;            ///< largest standard deviation of additive noise, grey levels
  double brightness_change = 0.12;   ///< largest relative gain change between the frames
  double color_change = 0.05;        ///< largest relative gain change per channel between the frames
  double gamma_change = 0.15;        ///< largest relative gamma change between the frames

  // Change that is not motion
  double blink_probability = 0.0;  ///< of a layer that is lit in one frame and dim in the other
  double light_probability = 0.0;  ///< of each of three lamps that shine in one frame only
  double jump_probability = 0.0;   ///< of scenes whose exposure jumps between the frames
  double jump_stops = 1.5;         ///< largest jump, in powers of two

  // Textures
  std::int64_t bank_size = 192;           ///< procedural textures in the bank
  std::int64_t texture_size = 256;        ///< side of a texture, pixels
  double flat_texture_share = 0.0;        ///< of the bank's textures that are nearly uniform
  double repetitive_texture_share = 0.0;  ///< of the bank's textures that are stripes or checks
  double photo_probability = 0.5;         ///< of taking a photograph crop where photographs were given

  double motion_boundary_px = 0.5;  ///< flow step between neighbours of different layers that counts as boundary
};

/// Throws Error(kInvalidArgument) that names the first field out of range.
void validate(const SceneConfig& config);

}  // namespace ajna::synth
