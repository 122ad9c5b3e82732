"""Pictures of a trained run: contact sheet, fly-through, PSNR against seconds (``make demo``)."""
