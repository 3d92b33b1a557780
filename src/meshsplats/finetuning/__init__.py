"""Fine-tuning meshes on pictures: losses and the optimiser's step. Parts need the extra ``finetune``."""
