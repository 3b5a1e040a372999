// Peers beside Embree: tinybvh (https://github.com/jbikker/tinybvh), if its folder was named when this was built.

#pragma once

#include "rays.h"

#include <memory>

// A tree of another ray tracer. Rays are traced by one call each.
class Peer {
  public:
    virtual ~Peer() = default;
    virtual std::string name() const = 0;
    // Takes rays in its own layout, before the clock runs.
    virtual void prepare(const Kind &k) = 0;
    virtual void run(size_t begin, size_t end) = 0;
    // What it has found: of hits the part of the ray's direction.
    virtual bool is_hit(size_t ray) const = 0;
    virtual float t(size_t ray) const = 0;
};

std::vector<std::unique_ptr<Peer>> peers(const Scene &s);
