//! The Underwater Bilateral Appearance Field: factors, guide, decoder, medium query, transport ratios
